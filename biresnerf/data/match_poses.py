"""What feature matches say about the poses of a set that has some: COLMAP, guided by the given poses."""

from __future__ import annotations

import importlib.util
import logging
import tempfile
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from biresnerf.data.colmap_process import run_colmap
from biresnerf.data.dataset import Dataset
from biresnerf.geometry.focus import focus_point
from biresnerf.geometry.pose_error import rotation_angle_deg
from biresnerf.geometry.similarity import align_robust

logger = logging.getLogger(__name__)

# Images; beyond it, each is matched with those whose given poses see most nearly the same.
ALL_PAIRS_UP_TO = 60
NEIGHBOURS = 40
LEAST_PLACED = 0.6  # of the images; a model of fewer says too little about the rig
# Standard deviation of given positions, of the cameras' distance: holds what matches leave open (the drift of narrow
# views, the mirror of flat scenes) and, under a robust loss, no more.
POSITION_DEVIATION = 0.2
# A camera that leaves its given pose by far more than the others do was placed by wrong matches (global mapping turned
# one of lego's by 92 deg where the others moved by 12): this many medians, but not below these floors.
STRAY, STRAY_DEG, STRAY_SHARE = 4.0, 30.0, 0.05
# A model with more of them is wrong as a whole (lego at 100 px: 23 of 78 stray, and the others are off by 17 deg).
STRAY_MOST = 0.15
# A start for the optimisation needs no more, and matching costs the features' square.
WIDEST_IMAGE, MOST_FEATURES = 1000, 2048
# COLMAP's bounds on reprojection errors are made for photos of thousands of px. At 200 px they let wrong matches pass:
# with 0.35 of them temple's mean rotation error went from 6.8 to 1.4 deg, entry-P10's from 4.9 to 0.8.
ERROR_SIZE = 1600  # px, long side at which COLMAP's own bounds hold; they shrink with the root of the size
# Pixels in all: affine shapes and pooled scales find more and cost several times as much.
THOROUGH_UP_TO = 10e6


@dataclass(frozen=True, eq=False)
class MatchedPoses:
    """Poses that one way of mapping found, carried into the frame of the given ones.

    Attributes:
        mapper: ``incremental`` or ``global``.
        world_from_cam: float64 [n, 4, 4]; images without enough matches keep their given pose.
        placed: bool [n], whether matches gave the pose.
        points: how many points the matches made.
    """

    mapper: str
    world_from_cam: NDArray[np.float64]
    placed: NDArray[np.bool_]
    points: int


def can_match() -> bool:
    """Whether COLMAP is installed."""
    return importlib.util.find_spec("pycolmap") is not None


def poses_from_matches(
    dataset: Dataset,
    *,
    should_stop: Callable[[], bool] | None = None,
    seed: int = 0,
    limit_s: float = 900.0,
) -> list[MatchedPoses]:
    """The rigs that feature matches support, best first by images placed; empty where texture does not suffice.

    Intrinsics are kept as given. Image pairs whose matches contradict the given poses by far more than most do are
    taken for repeated structure and left out.

    Raises:
        InputError: ``seed_timeout``.
        Interrupted: ``should_stop`` said so.
        RefinementError: ``seeding_crashed``.
    """
    # COLMAP's list of pairs knows no spaces, so photos go by numbers there.
    names = [f"{i:06}{frame.path.suffix}" for i, frame in enumerate(dataset.frames)]
    given = dataset.world_from_cam
    sizes = [dataset.camera_of(i) for i in range(len(names))]
    widest = min(WIDEST_IMAGE, float(np.median([max(c.width, c.height) for c in sizes])))
    with tempfile.TemporaryDirectory(prefix="biresnerf-matches-") as work:
        photos = Path(work, "photos")
        photos.mkdir()
        for name, frame in zip(names, dataset.frames, strict=True):
            (photos / name).symlink_to(frame.path.resolve())
        request = {
            "task": "from_given",
            "root": str(photos),
            "work": work,
            "answer": str(Path(work, "answer.json")),
            "seed": seed,
            "cameras": [
                {
                    "model": camera.model,
                    "params": list(camera.params),
                    "names": [n for n, f in zip(names, dataset.frames, strict=True) if f.camera == i],
                }
                for i, camera in enumerate(dataset.cameras)
            ],
            "cam_from_world": dict(zip(names, np.linalg.inv(given).tolist(), strict=True)),
            "position_deviation": POSITION_DEVIATION * focus_point(given).mean_distance,
            "pairs": None if len(names) <= ALL_PAIRS_UP_TO else _pairs(names, given),
            "widest_image": WIDEST_IMAGE,
            "error_scale": min(1.0, (widest / ERROR_SIZE) ** 0.5),
            "thorough": sum(c.width * c.height for c in sizes) <= THOROUGH_UP_TO,
            "most_features": MOST_FEATURES,
        }
        answer = run_colmap(request, Path(work), should_stop or (lambda: False), limit_s)
    found = [matched for model in answer["models"] if (matched := _carried(model, names, given)) is not None]
    return sorted(found, key=lambda matched: (-int(matched.placed.sum()), -matched.points))


def _pairs(names: list[str], world_from_cam: NDArray[np.float64]) -> list[tuple[str, str]]:
    """Each image with its `NEIGHBOURS` nearest: by centre, in distances of the scene, and by viewing direction."""
    centres = world_from_cam[:, :3, 3] / focus_point(world_from_cam).mean_distance
    apart = np.linalg.norm(centres[:, None] - centres[None], axis=2)
    apart = apart + np.linalg.norm(world_from_cam[:, None, :3, 2] - world_from_cam[None, :, :3, 2], axis=2)
    np.fill_diagonal(apart, np.inf)
    nearest = np.argsort(apart, axis=1, kind="stable")[:, :NEIGHBOURS]
    pairs = {(min(i, int(j)), max(i, int(j))) for i in range(len(names)) for j in nearest[i]}
    return [(names[i], names[j]) for i, j in sorted(pairs)]


def _carried(model: dict[str, Any], names: list[str], given: NDArray[np.float64]) -> MatchedPoses | None:
    """A model in the frame of the given poses; None where it holds too few of the images."""
    index = {name: i for i, name in enumerate(names)}
    rows = np.array([index[image["name"]] for image in model["images"]], dtype=np.int64)
    logger.info("matches place %d of %d images (%s mapping)", len(rows), len(names), model["mapper"])
    if len(rows) < max(3, LEAST_PLACED * len(names)):
        return None
    cam_from_model = np.tile(np.eye(4), (len(rows), 1, 1))
    cam_from_model[:, :3] = [image["cam_from_world"] for image in model["images"]]
    model_from_cam = np.linalg.inv(cam_from_model).astype(np.float64)
    similarity = align_robust(model_from_cam, given[rows], with_rotations=True)
    found = similarity.apply_to_poses(model_from_cam)
    turned = rotation_angle_deg(np.swapaxes(found[:, :3, :3], 1, 2) @ given[rows][:, :3, :3])
    shifted = np.linalg.norm(found[:, :3, 3] - given[rows][:, :3, 3], axis=1)
    trusted = (turned <= max(STRAY_DEG, STRAY * float(np.median(turned)))) & (
        shifted <= STRAY * max(float(np.median(shifted)), STRAY_SHARE * focus_point(given).mean_distance)
    )
    if trusted.sum() < LEAST_PLACED * len(names) or trusted.mean() < 1 - STRAY_MOST:
        logger.info(
            "not believed: %d of them leave their given pose by far more than the others", (~trusted).sum()
        )
        return None
    poses = given.copy()
    poses[rows[trusted]] = found[trusted]
    placed = np.zeros(len(names), dtype=np.bool_)
    placed[rows[trusted]] = True
    return MatchedPoses(model["mapper"], poses, placed, int(model["points"]))
