"""Small COLMAP models on disk, written byte by byte from COLMAP's description, and by pycolmap itself."""

from __future__ import annotations

import json
import struct
import subprocess
import sys
from pathlib import Path
from typing import Any

NO_POINT = 2**64 - 1


def image_record(number: int, name: bytes, points: int = 2, pose: tuple[float, ...] = (1, 0, 0, 0)) -> bytes:
    """One image of camera 7 at x = number; its first feature sees point 5, the others none."""
    record = struct.pack("<I7dI", number, *pose, float(number), 0.5, 2.0, 7) + name + b"\0"
    record += struct.pack("<Q", points)
    for index in range(points):
        record += struct.pack("<2dQ", 3.0 + index, 4.0, 5 if index == 0 else NO_POINT)
    return record


def tiny_tables() -> dict[str, bytes]:
    """A model of one camera (id 7), three images (ids 11 to 13), one point (id 5), one rig and three frames."""
    images = [(11, b"a.png"), (12, b"left/b b.png"), (13, b"c.png")]
    frame = "<II7dIiIQ"
    tracks = b"".join(struct.pack("<II", number, 0) for number, _ in images)
    return {
        "cameras.bin": struct.pack("<QIiQQ4d", 1, 7, 1, 20, 16, 18.0, 18.5, 10.25, 7.75),
        "images.bin": struct.pack("<Q", 3) + b"".join(image_record(*image) for image in images),
        "points3D.bin": struct.pack("<QQ3d3BdQ", 1, 5, 0.1, 0.2, 9.0, 255, 128, 0, 0.25, 3) + tracks,
        "rigs.bin": struct.pack("<QIIiI", 1, 2, 1, 0, 7),
        "frames.bin": struct.pack("<Q", 3)
        + b"".join(
            struct.pack(frame, 20 + n, 2, 1, 0, 0, 0, float(n), 0.5, 2.0, 1, 0, 7, n) for n, _ in images
        ),
    }


TINY_TEXT = {
    "cameras.txt": "# comment\n7 PINHOLE 20 16 18 18.5 10.25 7.75\n",
    "images.txt": (
        "# comment\n11 1 0 0 0 11 0.5 2 7 a.png\n3 4 5 4 4 -1\n"
        "12 1 0 0 0 12 0.5 2 7 left/b b.png\n3 4 5 4 4 -1\n13 1 0 0 0 13 0.5 2 7 c.png\n3 4 5 4 4 -1\n"
    ),
    "points3D.txt": "5 0.1 0.2 9 255 128 0 0.25 11 0 12 0 13 0\n",
    "rigs.txt": "2 1 CAMERA 7\n",
    "frames.txt": "".join(f"{20 + n} 2 1 0 0 0 {n} 0.5 2 1 CAMERA 7 {n}\n" for n in (11, 12, 13)),
}


def write_tables(folder: Path, tables: dict[str, Any]) -> Path:
    """Writes the files, bytes or text, and returns the folder."""
    folder.mkdir(parents=True, exist_ok=True)
    for name, content in tables.items():
        path = folder / name
        path.write_bytes(content) if isinstance(content, bytes) else path.write_text(content, "utf-8")
    return folder


_BY_PYCOLMAP = """
import zlib, json, sys  # zlib first: pycolmap's own breaks Python's
from pathlib import Path
import numpy as np, pycolmap
request = json.load(sys.stdin)
def described(rec):
    def pose(p):
        return [p.rotation.quat[[3, 0, 1, 2]].tolist(), p.translation.tolist()]
    return {
        "cameras": {i: [c.model.name, c.width, c.height, c.params.tolist()] for i, c in rec.cameras.items()},
        "images": {
            i: [m.name, m.camera_id, pose(m.cam_from_world()), [p.xy.tolist() for p in m.points2D],
                [p.point3D_id if p.has_point3D() else -1 for p in m.points2D]]
            for i, m in rec.images.items() if m.has_pose
        },
        "points": {
            i: [p.xyz.tolist(), p.color.tolist(), p.error,
                sorted([e.image_id, e.point2D_idx] for e in p.track.elements)]
            for i, p in rec.points3D.items()
        },
        "rigs": {
            i: [[r.ref_sensor_id.type.name, r.ref_sensor_id.id],
                sorted([s.type.name, s.id, pose(p)] for s, p in r.non_ref_sensors.items())]
            for i, r in rec.rigs.items()
        },
        "frames": {
            i: [f.rig_id, pose(f.rig_from_world),
                sorted([d.sensor_id.type.name, d.sensor_id.id, d.id] for d in f.data_ids)]
            for i, f in rec.frames.items() if f.has_pose()
        },
    }
answers = []
for made in request["make"]:
    pycolmap.set_random_seed(made["seed"])
    options = pycolmap.SyntheticDatasetOptions()
    for key, value in made["options"].items():
        setattr(options, key, getattr(pycolmap.CameraModelId, value) if key == "camera_model_id" else value)
    rec = pycolmap.synthesize_dataset(options)
    rng = np.random.default_rng(made["seed"])
    for frame in rec.frames.values():
        quat = rng.normal(size=4)
        rotation = pycolmap.Rotation3d(quat / np.linalg.norm(quat))
        frame.rig_from_world = pycolmap.Rigid3d(rotation, rng.normal(size=3) * 10)
    for form, write in (("binary", rec.write_binary), ("text", rec.write_text)):
        folder = Path(made["folder"], form)
        folder.mkdir(parents=True)
        write(str(folder))
    answers.append(described(pycolmap.Reconstruction(str(Path(made["folder"], "binary")))))
answers += [described(pycolmap.Reconstruction(folder)) for folder in request["read"]]
json.dump(answers, sys.stdout)
"""


def by_pycolmap(make: list[dict[str, Any]], read: list[Path] | None = None) -> list[dict[str, Any]]:
    """What pycolmap, in a process of its own, says of models it makes (both forms) and of models it reads."""
    request = {"make": make, "read": [str(folder) for folder in read or []]}
    answer = subprocess.run(
        [sys.executable, "-c", _BY_PYCOLMAP],
        input=json.dumps(request),
        capture_output=True,
        text=True,
        timeout=120,
        check=False,
    )
    assert answer.returncode == 0, answer.stderr
    return json.loads(answer.stdout)
