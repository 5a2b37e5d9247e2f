"""A drone's photos of a synthetic neighbourhood, with exact truth: for hundreds to thousands of photos.

    python -m benchmarks.large.made_aerial OUT --photos 500 [--first 300] [--width 1000] [--poses]
    biresnerf refine OUT --output RESULT
    biresnerf evaluate RESULT OUT.truth.json

The drone flies lines over a square, as mapping flights do: photos overlap by 80 % along a line and by 65 % across.
Photos are JPEG with the EXIF and XMP that a DJI Mavic 3 writes; positions are off by `--metres`, yaw and pitch of the
gimbal by `--degrees`. With `--poses`, OUT/transforms.json holds poses with errors of the same sizes. Existing photos
are not rendered again, so a stopped command can be resumed.
"""

from __future__ import annotations

import argparse
import json
import time
from dataclasses import replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from benchmarks.sets.aerial_ground import render
from biresnerf.data.model.conventions import file_from_world_from_cam
from biresnerf.data.synthetic.camera_photos import MAKERS, write_camera_photo
from biresnerf.geometry.earth.geodesy import held_so
from biresnerf.geometry.rigid import motion_of

Array = NDArray[np.float64]

FOCAL_OF_WIDTH = 0.69  # 24 mm on film
ABOVE_M = 62.0
ALONG, ACROSS = 0.80, 0.65
PITCH_DEG, UNEVEN_DEG, UNEVEN_M = -78.0, 2.0, 1.2
EXPOSED = 1.25


def poses_of(yaw_deg: Array, pitch_deg: Array, centres: Array) -> Array:
    """world_from_cam [n, 4, 4] of level cameras: yaw from north by east, pitch above the horizon; x east, z up."""
    angles = np.stack([yaw_deg, pitch_deg, np.zeros_like(yaw_deg)], 1)
    return motion_of(held_so(angles), centres)


def flight(count: int, rng: np.random.Generator) -> tuple[Array, Array, Array]:
    """Yaw, pitch (degrees) [count] and centres (m) [count, 3] of a flight in lines over a near-square."""
    footprint = ABOVE_M / FOCAL_OF_WIDTH * np.array([1.0, 0.75])
    apart, step = footprint * (1 - np.array([ACROSS, ALONG]))
    lines = max(1, round((count * step / apart) ** 0.5))
    each = -(-count // lines)
    line, along = np.divmod(np.arange(count), each)
    north = line % 2 == 0
    y = np.where(north, along, each - 1 - along) * step
    centres = np.stack([line * apart, y, np.full(count, ABOVE_M)], 1) + rng.normal(0, UNEVEN_M, (count, 3))
    yaw = np.where(north, 0.0, 180.0) + rng.normal(0, UNEVEN_DEG, count)
    return yaw, PITCH_DEG + rng.normal(0, UNEVEN_DEG, count), centres


def write_photo(
    path: Path, truth: Array, said: Array, number: int, width: int, seed: int, metres: float
) -> None:
    """Render at the true pose, and write the drone's metadata."""
    focal = FOCAL_OF_WIDTH * width
    linear, _ = render(truth, width, width * 3 // 4, focal, seed)
    shown = np.rint(255 * np.clip(EXPOSED * linear, 0, 1) ** (1 / 2.2)).astype(np.uint8)
    drone = replace(MAKERS["drone"], gps_m=metres, unit_m=1.0)
    write_camera_photo(path, shown, drone, number, focal, said)


def transforms(poses: Array, names: list[str], width: int) -> str:
    """nerfstudio's transforms.json."""
    lens = {"fl_x": FOCAL_OF_WIDTH * width, "fl_y": FOCAL_OF_WIDTH * width, "w": width, "h": width * 3 // 4}
    lens |= {"cx": width / 2, "cy": lens["h"] / 2, "camera_model": "PINHOLE"}
    matrices = file_from_world_from_cam(poses, np.eye(4), 1.0).tolist()
    frames = [
        {"file_path": name, "transform_matrix": matrix} for name, matrix in zip(names, matrices, strict=True)
    ]
    return json.dumps({**lens, "frames": frames})


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("out", type=Path)
    parser.add_argument("--photos", type=int, default=500)
    parser.add_argument("--first", type=int, help="Of the flight, only these.")
    parser.add_argument("--width", type=int, default=1000, help="px, of 4 to 3.")
    parser.add_argument("--metres", type=float, default=2.0, help="Standard deviation of GPS.")
    parser.add_argument(
        "--degrees", type=float, default=2.0, help="Standard deviation of the gimbal's angles."
    )
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--poses", action="store_true", help="Write poses, too.")
    asked = parser.parse_args()
    rng = np.random.default_rng(asked.seed)
    yaw, pitch, centres = flight(asked.photos, rng)
    truth = poses_of(yaw, pitch, centres)
    off_yaw, off_pitch = rng.normal(0, asked.degrees, (2, asked.photos))
    said = poses_of(yaw + off_yaw, pitch + off_pitch, centres)
    taken = min(asked.photos, asked.first or asked.photos)
    names = [f"images/DJI_{number + 1:05}.JPG" for number in range(taken)]
    begun, rendered = time.monotonic(), 0
    for number, name in enumerate(names):
        if not (path := asked.out / name).exists():
            half = path.with_suffix(".part")
            write_photo(half, truth[number], said[number], number, asked.width, asked.seed, asked.metres)
            half.rename(path)
            rendered += 1
            left = (time.monotonic() - begun) / rendered * (taken - number - 1)
            print(f"\r{number + 1} of {taken}, {left / 60:.0f} min left ", end="", flush=True)
    asked.out.with_name(f"{asked.out.name}.truth.json").write_text(
        transforms(truth[:taken], [f"{asked.out.name}/{name}" for name in names], asked.width)
    )
    if asked.poses:
        said[:, :3, 3] += rng.normal(0, asked.metres, (asked.photos, 3))
        (asked.out / "transforms.json").write_text(transforms(said[:taken], names, asked.width))
    print(f"\n{asked.out}: {taken} photos")


if __name__ == "__main__":
    main()
