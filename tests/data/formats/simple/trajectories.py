"""Sets of four images with poses in the forms of other programs, written from those programs' own descriptions."""

from __future__ import annotations

import struct
from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation

from biresnerf.data.model.dataset import Dataset
from biresnerf.geometry.camera.camera_models import Camera
from tests.data.formats.colmap.colmap_files import write_tables
from tests.data.scenes import HEIGHT, WIDTH, opengl_poses, write_image

NAMES = ("a.png", "b.png", "c.png", "d.png")
FLIP = np.diag([1.0, -1.0, -1.0])
CAMERA_JSON = '{"fl_x": 18.0, "fl_y": 18.5, "cx": 10.25, "cy": 7.75, "w": 20, "h": 16, "k1": 0.01}'


def truth() -> np.ndarray:
    """``world_from_cam`` [4, 4, 4], OpenCV axes."""
    poses = np.array(opengl_poses(4))
    poses[:, :3, :3] = poses[:, :3, :3] @ FLIP
    return poses


GIVEN_CAMERA = Camera("PINHOLE", WIDTH, HEIGHT, (18.0, 18.5, 10.25, 7.75))


def assert_at_truth(dataset: Dataset, poses: np.ndarray | None = None) -> None:
    """All frames have the given pose `truth` says, or ``poses`` [4, 4, 4]."""
    assert dataset.posed.all()
    np.testing.assert_allclose(dataset.world_from_cam, truth() if poses is None else poses, atol=1e-12)
    assert {frame.pose_source for frame in dataset.frames} == {"given"}


def write_images(folder: Path, names: tuple[str, ...] = NAMES) -> None:
    for index, name in enumerate(names):
        write_image(folder / "images" / name, index)


def colmap_set(folder: Path, names: tuple[str, ...] = NAMES, registered: int = 4, lens: str = "") -> Path:
    """A text model in sparse/0; images not registered are on disk all the same."""
    write_images(folder, names)
    rows = []
    for number, (name, pose) in enumerate(zip(names[:registered], truth(), strict=False), start=1):
        rotation = pose[:3, :3].T
        x, y, z, w = Rotation.from_matrix(rotation).as_quat()
        t = -rotation @ pose[:3, 3]
        rows.append(f"{number} {w!r} {x!r} {y!r} {z!r} {t[0]!r} {t[1]!r} {t[2]!r} 1 {name}\n\n")
    tables = {
        "cameras.txt": f"1 {lens or 'PINHOLE 20 16 18 18.5 10.25 7.75'}\n",
        "images.txt": "".join(rows).replace("np.float64(", "").replace(")", ""),
        "points3D.txt": "",
    }
    return write_tables(folder / "sparse/0", tables)


def llff_set(folder: Path, size: tuple[int, int] = (WIDTH, HEIGHT), focal: float = 18.0) -> Path:
    """poses_bounds.npy as LLFF's imgs2poses writes it: columns down, right, back; then height, width, focal length."""
    write_images(folder)
    rows = []
    for pose in truth():
        right, down, forward = pose[:3, :3].T
        hwf = np.array([size[1], size[0], focal])
        matrix = np.stack([down, right, -forward, pose[:3, 3], hwf], axis=1)
        rows.append(np.concatenate([matrix.ravel(), [1.0, 10.0]]))
    np.save(folder / "poses_bounds.npy", np.array(rows))
    return folder / "poses_bounds.npy"


def tum_lines(times: list[str]) -> list[str]:
    lines = []
    for time, pose in zip(times, truth(), strict=True):
        values = [*pose[:3, 3].tolist(), *Rotation.from_matrix(pose[:3, :3]).as_quat().tolist()]
        lines.append(" ".join([time, *map(repr, values)]))
    return lines


def tum_set(folder: Path, times: list[str], names: tuple[str, ...] = NAMES, head: str = "") -> Path:
    write_images(folder, names)
    (folder / "camera.json").write_text(CAMERA_JSON)
    (folder / "trajectory.txt").write_text(head + "\n".join(tum_lines(times)) + "\n")
    return folder / "trajectory.txt"


def kitti_set(folder: Path) -> Path:
    write_images(folder)
    rows = [" ".join(map(repr, pose[:3].ravel().tolist())) for pose in truth()]
    (folder / "poses.txt").write_text("\n".join(rows) + "\n")
    (folder / "calib.txt").write_text("P0: 18 0 10.25 0 0 18.5 7.75 0 0 0 1 0\nP1: 0 0 0 0 0 0 0 0 0 0 0 0\n")
    return folder / "poses.txt"


def bundler_set(folder: Path, listed: bool = True, unposed: int | None = None) -> Path:
    """bundle.out v0.3 with one point; cameras look along -z, y up."""
    write_images(folder)
    lines = ["# Bundle file v0.3", "4 1"]
    for index, pose in enumerate(truth()):
        rotation = FLIP @ pose[:3, :3].T
        t = -rotation @ pose[:3, 3]
        if index == unposed:
            lines += ["0 0 0"] * 5
            continue
        lines.append("18.5 0.01 -0.002")
        lines += [" ".join(map(repr, row)) for row in [*rotation.tolist(), t.tolist()]]
    lines += ["0.5 0.25 9", "255 0 0", "1 0 0 1.5 2.5"]
    (folder / "bundle.out").write_text("\n".join(lines) + "\n")
    if listed:
        (folder / "list.txt").write_text("".join(f"./images/{name} 0 18.5\n" for name in NAMES))
    return folder / "bundle.out"


def metashape_xml(lens: str = "", cameras: str | None = None) -> str:
    """A camera export of Metashape 2: pixel offsets of the principal point from the centre, poses camera to chunk."""
    if cameras is None:
        cameras = "".join(
            f'<camera id="{i}" sensor_id="0" component_id="0" label="{Path(name).stem}"><transform>'
            f"{' '.join(map(repr, pose.ravel().tolist()))}</transform></camera>"
            for i, (name, pose) in enumerate(zip(NAMES, truth(), strict=True))
        )
    return (
        '<?xml version="1.0" encoding="UTF-8"?><document version="2.0.0"><chunk label="Chunk 1" enabled="true">'
        '<sensors next_id="1"><sensor id="0" label="phone" type="frame"><resolution width="20" height="16"/>'
        '<calibration type="frame" class="adjusted"><resolution width="20" height="16"/>'
        f"<f>18.5</f><cx>0.25</cx><cy>-0.25</cy>{lens}</calibration></sensor></sensors>"
        f"<cameras>{cameras}</cameras></chunk></document>"
    )


FORMS = ("colmap", "llff", "tum", "kitti", "bundler", "metashape")


def write_set(form: str, folder: Path) -> None:
    """The four images with their true poses, in the form of that name."""
    if form == "metashape":
        write_images(folder)
        (folder / "cameras.xml").write_text(metashape_xml())
    elif form == "tum":
        tum_set(folder, ["0", "1", "2", "3"])
    else:
        {"colmap": colmap_set, "llff": llff_set, "kitti": kitti_set, "bundler": bundler_set}[form](folder)


def npy_bytes(header: str, content: bytes) -> bytes:
    """A file of the npy format, version 1.0, with any header."""
    padded = header.encode().ljust(118 - len(header) % 64) + b"\n"
    return b"\x93NUMPY\x01\x00" + struct.pack("<H", len(padded)) + padded + content
