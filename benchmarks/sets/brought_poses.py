"""Sets as users bring them, made from one whose poses are known.

    python -m benchmarks.sets.brought_poses SET OUT [--seed 1]
    biresnerf refine OUT/predicted -o RESULT && biresnerf evaluate RESULT SET
    biresnerf refine OUT/first -o FIRST && biresnerf refine OUT/all -o ALL --fixed-from FIRST

OUT gets `predicted`, the photos and a predictions.npz as VGGT writes it: cameras turned by 2 degrees and moved by 5 %
of the distance (standard deviations), another scale, focal length 7 % too long; `first`, two of three photos with
BARF's noise of 0.05 on their poses; and `all`, the photos alone. SET is a folder with images and transforms.json.
"""

from __future__ import annotations

import argparse
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from biresnerf.data.formats.read_dataset import read_dataset
from biresnerf.data.formats.transforms.write_transforms import write_transforms
from biresnerf.data.model.dataset import Dataset
from biresnerf.data.model.part_of_set import without_photos
from biresnerf.geometry.focus import focus_point
from biresnerf.geometry.perturb import perturb_poses
from biresnerf.geometry.rigid import rotation_of
from biresnerf.studies.scenes import with_poses

TURNED_DEG, MOVED, LONGER, NOISE = 2.0, 0.05, 1.07, 0.05
WIDTH, PATCH = 518, 14  # px: what VGGT shrinks photos to, and whole patches of


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("set", type=Path)
    parser.add_argument("out", type=Path)
    parser.add_argument("--seed", type=int, default=1)
    asked = parser.parse_args()
    whole = read_dataset(asked.set)
    for name in ("predicted", "all"):
        _link_photos(whole, asked.out / name)
    _predict(whole, asked.seed, asked.out / "predicted/predictions.npz")
    first = without_photos(whole, whole.names[::3])
    _link_photos(first, asked.out / "first")
    noisy = perturb_poses(first.world_from_cam, NOISE, asked.seed)
    write_transforms(with_poses(first, noisy), noisy, asked.out / "first/transforms.json")


def _link_photos(dataset: Dataset, folder: Path) -> None:
    for frame, name in zip(dataset.frames, dataset.file_names, strict=True):
        place = folder / name
        place.parent.mkdir(parents=True, exist_ok=True)
        place.symlink_to(frame.path.resolve())


def _predict(dataset: Dataset, seed: int, path: Path) -> None:
    """Writes a feed-forward model's predictions for the photos, in the order of their names."""
    camera, count = dataset.camera_of(0), len(dataset)
    scale = WIDTH / camera.width
    height = round(camera.height * scale / PATCH) * PATCH
    lens = camera.full()
    matrix = [
        [LONGER * lens.fx * scale, 0.0, WIDTH / 2],
        [0.0, LONGER * lens.fy * scale, height / 2],
        [0.0, 0.0, 1.0],
    ]
    poses = _guessed(dataset.world_from_cam, seed)[np.argsort(dataset.names)]
    np.savez(
        path,
        extrinsic=np.linalg.inv(poses)[:, :3].astype(np.float32),
        intrinsic=np.tile(np.array(matrix, np.float32), (count, 1, 1)),
        depth=np.ones((count, height, WIDTH, 1), np.float32),
    )


def _guessed(world_from_cam: NDArray[np.float64], seed: int) -> NDArray[np.float64]:
    """Poses [n, 4, 4] with a prediction's errors, in units of the distance to the scene."""
    rng = np.random.default_rng(seed)
    distance = focus_point(world_from_cam).mean_distance
    turns = rotation_of(rng.normal(0, np.radians(TURNED_DEG), (len(world_from_cam), 3)))
    poses = world_from_cam.copy()
    poses[:, :3, :3] = turns @ poses[:, :3, :3]
    poses[:, :3, 3] /= distance
    poses[:, :3, 3] += rng.normal(0, MOVED, (len(poses), 3))
    return poses


if __name__ == "__main__":
    main()
