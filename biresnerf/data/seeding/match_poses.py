"""Models that feature matches support: carried into the frame of given poses, and whether to believe them."""

from __future__ import annotations

import importlib.util
import logging
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from biresnerf.data.formats.positions.position_priors import position_priors
from biresnerf.data.model.dataset import Dataset, Frame
from biresnerf.data.points.located_points import metres_from_world
from biresnerf.data.seeding.map_images import MappedModel
from biresnerf.geometry.body_offset import tie
from biresnerf.geometry.focus import focus_point
from biresnerf.geometry.pose_error import rotation_between_deg
from biresnerf.geometry.rigid import rigid_inverse, rotation_vectors
from biresnerf.geometry.similarity import align_robust

logger = logging.getLogger(__name__)

# A camera that leaves its given pose by far more than the others do was placed by wrong matches (global mapping turned
# one of lego's by 92 deg where the others moved by 12): this many medians, but not below these floors. Rotations show
# most. Noisy positions of few cameras scatter: at noise 0.15 true poses of 10 to 20 cameras are up to 6 medians away.
STRAY_TURNS, STRAY_DEG = 4.0, 30.0
STRAY_SHIFTS, STRAY_SHARE = 8.0, 0.2  # the floor is a share of the cameras' distance
# A model with more of them is wrong as a whole (lego at 100 px: 23 of 78 stray, and the others are off by 17 deg).
STRAY_MOST = 0.15
JUDGED_FROM = 3  # given poses in a model; fewer tie it to their frame and say nothing of it
OPENGL = frozenset({"nerfstudio", "instant-ngp", "blender", "bundler"})  # formats whose cameras look along -z
AXES = ("OpenGL axes (x right, y up, z back)", "OpenCV axes (x right, y down, z forward)")
INVERTED = (
    "The given matrices look inverted: from the world to the camera, where those from the camera to the world are "
    "expected. Feature matches show it, and they were inverted before anything else."
)
NEARLY_DEG, NEARLY = 1.0, 0.9998  # a turn that has a name: its angle, and the cosine of its axis


@dataclass(frozen=True, eq=False)
class MatchedPoses:
    """Poses that one way of mapping found, in the frame of the given ones.

    Attributes:
        mapper: ``incremental`` or ``global``.
        world_from_cam: float64 [n, 4, 4]; as given where not placed.
        placed: bool [n], whether matches gave the pose.
    """

    mapper: str
    world_from_cam: NDArray[np.float64]
    placed: NDArray[np.bool_]


def can_match() -> bool:
    """Whether COLMAP is installed."""
    return importlib.util.find_spec("pycolmap") is not None


def carry_model(
    model: MappedModel, given: NDArray[np.float64], posed: NDArray[np.bool_], *, judged: bool = True
) -> MatchedPoses | None:
    """A model in the frame of the given poses [n, 4, 4], of which those ``posed`` [n] count.

    Cameras that stray from their given pose by far more than the others are left at it, unless ``judged`` is false.
    None where too many do, or where the model holds no image with a given pose.
    """
    rows = model.rows
    common = posed[rows]
    if not common.any():
        return None
    there = given[rows][common]
    similarity = align_robust(model.world_from_cam[common], there, with_rotations=True)
    found = similarity.apply_to_poses(model.world_from_cam)
    trusted = np.ones(len(rows), dtype=np.bool_)
    if judged and common.sum() >= JUDGED_FROM:
        here = found[common]
        turned = rotation_between_deg(here, there)
        shifted = np.linalg.norm(here[:, :3, 3] - there[:, :3, 3], axis=1)
        nearby = STRAY_SHARE * focus_point(given[posed]).mean_distance
        trusted[common] = (turned <= max(STRAY_DEG, STRAY_TURNS * float(np.median(turned)))) & (
            shifted <= max(nearby, STRAY_SHIFTS * float(np.median(shifted)))
        )
        if trusted[common].mean() < 1 - STRAY_MOST:
            logger.info(
                "%s mapping rejected: %d of %d images leave their given pose by far more than the others",
                model.mapper, (~trusted).sum(), common.sum(),
            )  # fmt: skip
            return None
    poses = given.copy()
    poses[rows[trusted]] = found[trusted]
    placed = np.zeros(len(given), dtype=np.bool_)
    placed[rows[trusted]] = True
    return MatchedPoses(model.mapper, poses, placed)


def in_measured_frame(matched: MatchedPoses, dataset: Dataset) -> MatchedPoses:
    """Poses in metres in the frame of control points or measured positions, where these determine it.

    For degrees along east, north and up; by a similarity that is robust to wrong positions. Otherwise they stay.

    Raises:
        InputError: ``positions_invalid``, or a code of `open_image`.
    """
    dataset = replace(dataset, positions=position_priors(dataset))
    frame = metres_from_world(dataset, matched.world_from_cam, matched.placed)
    if frame is None:
        return matched
    found = frame.apply_to_poses(matched.world_from_cam)
    return replace(
        matched, world_from_cam=np.where(matched.placed[:, None, None], found, matched.world_from_cam)
    )


def without_offset(dataset: Dataset, models: Sequence[MappedModel]) -> Dataset:
    """The set with the cameras' poses in place of those of bodies that carry them, where a model shows these.

    The best model decides: its frame is found with the offset, so that the given frame stays. It also shows whether the
    given matrices are inverted.
    """
    given = [frame.world_from_cam for frame in dataset.frames]
    pairs = [
        (here, there)
        for model in models[:1]
        for here, row in zip(model.world_from_cam, model.rows, strict=True)
        if (there := given[row]) is not None
    ]
    if not pairs:
        return dataset
    fitted, there = (np.stack(rig) for rig in zip(*pairs, strict=True))
    axes = np.diag([1.0, -1, -1, 1]) if dataset.source.dialect in OPENGL else np.eye(4)
    found, other = tie(fitted, there), tie(fitted, axes @ rigid_inverse(there) @ axes)
    words = []
    if inverted := other.explains_more_than(found):
        found = other
        words.append(INVERTED)
    if found.offset is not None:
        words.append(offset_words(found.offset.body_from_cam, dataset.source.dialect))
    if not words:
        return dataset
    logger.info("%s", " ".join(words))
    body_from_cam = np.eye(4) if found.offset is None else found.offset.body_from_cam

    def taken_back(frame: Frame) -> Frame:
        if frame.world_from_cam is None:
            return frame
        pose = axes @ rigid_inverse(frame.world_from_cam) @ axes if inverted else frame.world_from_cam
        raw = {key: value for key, value in frame.raw.items() if key != "transform_matrix"}
        return replace(frame, world_from_cam=pose @ body_from_cam, raw=raw)

    frames = tuple(taken_back(frame) for frame in dataset.frames)
    return replace(dataset, frames=frames, body_offset=found.offset, warnings=(*dataset.warnings, *words))


def offset_words(body_from_cam: NDArray[np.float64], dialect: str) -> str:
    """A warning that says what was found, by name where it is a turn that people know."""
    vector = np.degrees(rotation_vectors(body_from_cam[None, :3, :3])[0])
    angle, shift = float(np.linalg.norm(vector)), float(np.linalg.norm(body_from_cam[:3, 3]))
    moved = f"shifted by {shift:.3g} units" if shift else ""
    if _nearly(angle, 180.0) and abs(vector[0]) > angle * NEARLY:
        expected, found = AXES if dialect in OPENGL else AXES[::-1]
        what = f"look like {found}, where this format has {expected}"
    elif angle and abs(vector[2]) > angle * NEARLY:
        what = f"are rolled by {angle:.3g} degrees about the viewing axes of the cameras"
    elif angle:
        axis = ", ".join(f"{part:.2f}" for part in vector / angle)
        what = f"are all turned by {angle:.3g} degrees about ({axis}) in the axes of the cameras"
    else:
        what, moved = f"are all {moved} in the axes of the cameras", ""
    like = ", as those of a robot's flange, a phone or another tracked body are" if shift else ""
    return (
        f"The given poses {what}{f', and {moved}' if moved else ''}{like}. Feature matches show it, and it was taken "
        "back before anything else: poses are those of the cameras now, in the input's own world."
    )


def _nearly(angle: float, round_number: float) -> bool:
    return abs(angle - round_number) < NEARLY_DEG
