"""The scenes of a comparison: found, read, and given start poses."""

from __future__ import annotations

import hashlib
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from biresnerf.data.formats.folder import look_into
from biresnerf.data.formats.transforms.read_transforms import read_transforms
from biresnerf.data.model.dataset import Dataset
from biresnerf.data.photos.named_images import refuse_too_few
from biresnerf.errors import InputError
from biresnerf.refinement.views.held_out_views import evenly_spread
from biresnerf.studies.cell import Perturbation, Scene

TRAIN_NAME, TEST_NAME = "transforms_train.json", "transforms_test.json"


@dataclass(frozen=True, eq=False)
class StartingRig:
    """Start poses world_from_cam [n, 4, 4], and which cameras were displaced on top of the noise."""

    world_from_cam: NDArray[np.float64]
    displaced: tuple[int, ...]


def find_scene(path: Path, every: int, test_views: int) -> Scene:
    """The scene in a folder or of a transforms file, read once to validate it.

    Views of a transforms_test.json beside a transforms_train.json are test views.

    Raises:
        InputError: as `read_transforms`, or ``poses_missing`` if images have no pose.
    """
    file = path
    if path.is_dir():
        contents = look_into(path)
        if contents.poses is None or contents.format != "transforms":
            raise InputError(
                "poses_missing",
                "has no true poses to compare with.",
                where=str(path),
                hint="Give a folder with a transforms.json.",
            )
        file = contents.poses
    elif not path.is_file():
        raise InputError("input_missing", "does not exist.", where=str(path), hint="Name a scene's folder.")
    beside = file.with_name(TEST_NAME)
    test_file = beside if file.name == TRAIN_NAME and beside.is_file() and test_views else None
    digest = hashlib.sha256(file.read_bytes())
    if test_file is not None:
        digest.update(test_file.read_bytes())
    name = file.resolve().parent.name if file.name in (TRAIN_NAME, "transforms.json") else file.stem
    scene = Scene(
        name=name,
        file=file.resolve(),
        test_file=test_file.resolve() if test_file is not None else None,
        digest=digest.hexdigest(),
        every=every,
        test_views=test_views if test_file is not None else 0,
    )
    views = read_scene(scene)
    refuse_too_few(len(views), f"{file} (every {every})")
    if not views.posed.all():
        raise InputError(
            "poses_missing",
            f"{int((~views.posed).sum())} of {len(views)} frames have no true pose to compare with.",
            where=str(file),
            hint="Remove these frames.",
        )
    read_test_views(scene)
    return scene


def read_scene(scene: Scene) -> Dataset:
    """The views that are optimised, with their true poses."""
    dataset = read_transforms(scene.file)
    return replace(dataset, frames=dataset.frames[:: scene.every])


def read_test_views(scene: Scene) -> Dataset | None:
    """Evenly spread test views with their true poses; None where the scene has none of its own."""
    if scene.test_file is None:
        return None
    dataset = read_transforms(scene.test_file)
    count = min(scene.test_views, len(dataset))
    chosen = evenly_spread(range(len(dataset)), count)
    return replace(dataset, frames=tuple(dataset.frames[i] for i in chosen))


def with_poses(dataset: Dataset, world_from_cam: NDArray[np.float64]) -> Dataset:
    """The same set with these poses [n, 4, 4], as if its file had them."""
    frames = []
    for frame, pose in zip(dataset.frames, world_from_cam, strict=True):
        # Poses that are kept are written in the digits of the file, and these are the true ones.
        raw = {key: value for key, value in frame.raw.items() if key != "transform_matrix"}
        frames.append(replace(frame, world_from_cam=pose, raw=raw))
    return replace(dataset, frames=tuple(frames))


def starting_rig(truth: NDArray[np.float64], start: Perturbation) -> StartingRig:
    """True poses [n, 4, 4] perturbed by `start`; deterministic for a seed."""
    from biresnerf.geometry.perturb import orbit_away, perturb_poses, turn_in_place

    count = len(truth)
    if start.kind == "identity":
        poses = np.tile(np.eye(4), (count, 1, 1))
    else:
        poses = perturb_poses(truth, start.noise, start.seed)
    order = np.random.default_rng([start.seed, 2]).permutation(count)
    displaced: list[int] = []
    if start.lose_share:
        displaced = [int(i) for i in order[: max(1, round(start.lose_share * count))]]
        poses = orbit_away(poses, displaced, start.seed)
    if start.turn_one_deg:
        turned = int(order[-1])
        poses = turn_in_place(poses, turned, start.turn_one_deg)
        displaced = sorted({*displaced, turned})
    return StartingRig(poses, tuple(sorted(displaced)))
