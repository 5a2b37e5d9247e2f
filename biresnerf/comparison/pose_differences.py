"""How the poses of two results differ, against what both state of their accuracy."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from biresnerf.arrays import Array
from biresnerf.comparison.conclusion import PoseDifference
from biresnerf.data.formats.simple.poses_json import PoseImage, PosesDocument
from biresnerf.geometry.focus import rms_spread
from biresnerf.geometry.pose_error import rotation_between_deg
from biresnerf.geometry.similarity import align_robust
from biresnerf.uncertainty import PoseUncertainty

# Nine of ten errors are within a bound, so chance all but never takes a pose beyond three.
FAR_BOUNDS = 3.0
GROSS_DEG = 5.0  # where no accuracy is stated
EQUAL_DEG, EQUAL_SHARE = 1e-4, 1e-6  # what rounding leaves of equal poses; of the cameras' spread


@dataclass(frozen=True)
class PoseDifferences:
    """The pose differences of the photos that both results hold.

    Attributes:
        rows: in the order of the first result.
        equal: whether all poses are the same but for rounding.
        bounds: the median photo's pose difference, in multiples of the accuracy that both state; None if most photos
            have no stated accuracy.
        stated_deg: that accuracy as a rotation, the median photo; None if most have none.
    """

    rows: tuple[PoseDifference, ...]
    equal: bool
    bounds: float | None
    stated_deg: float | None

    @property
    def contradicting(self) -> tuple[PoseDifference, ...]:
        """The photos for which the results cannot both be right."""
        return tuple(row for row in self.rows if row.contradicts)

    @property
    def median_deg(self) -> float:
        """The rotation between the two poses of the median photo."""
        return float(np.median([row.turned_deg for row in self.rows]))


def pose_differences(first: PosesDocument, second: PosesDocument) -> PoseDifferences:
    """Differences after the second rig is aligned with the first: stated accuracies are those of aligned rigs."""
    others = {image.name: image for image in second.images}
    pairs = [(image, others[image.name]) for image in first.images if image.name in others]
    if not pairs:
        return PoseDifferences((), equal=False, bounds=None, stated_deg=None)
    a, b = (_matrices([pair[side] for pair in pairs]) for side in (0, 1))
    first_from_second = align_robust(b, a, with_rotations=True)
    b = first_from_second.apply_to_poses(b)
    turned = rotation_between_deg(a, b)
    moved: Array = np.linalg.norm(a[:, :3, 3] - b[:, :3, 3], axis=1)
    bounds = [_joint(one.uncertainty, other.uncertainty, first_from_second.scale) for one, other in pairs]
    ratios = [_ratio(*each) for each in zip(turned, moved, bounds, strict=True)]
    rows = tuple(
        PoseDifference(
            name=image.name,
            turned_deg=float(turn),
            moved=float(shift),
            contradicts=turn > GROSS_DEG if ratio is None else ratio > FAR_BOUNDS,
        )
        for (image, _), turn, shift, ratio in zip(pairs, turned, moved, ratios, strict=True)
    )
    known = [ratio for ratio in ratios if ratio is not None]
    mostly = 2 * len(known) >= len(pairs)
    spread = max(rms_spread(a[:, :3, 3]), 1e-300)
    return PoseDifferences(
        rows,
        equal=bool(turned.max() <= EQUAL_DEG and moved.max() <= EQUAL_SHARE * spread),
        bounds=float(np.median(known)) if mostly else None,
        stated_deg=float(np.median([bound[0] for bound in bounds if bound])) if mostly else None,
    )


def _matrices(images: list[PoseImage]) -> Array:
    poses = np.tile(np.eye(4), (len(images), 1, 1))
    poses[:, :3] = [image.world_from_cam for image in images]
    return poses


def _joint(
    one: PoseUncertainty | None, other: PoseUncertainty | None, first_per_second: float
) -> tuple[float, float | None] | None:
    """Bounds on the difference of two poses, degrees and units of the first: errors of both, taken as independent."""
    if one is None or other is None or one.rotation_deg is None or other.rotation_deg is None:
        return None
    turn = float(np.hypot(one.rotation_deg, other.rotation_deg))
    if one.position is None or other.position is None:
        return turn, None
    return turn, float(np.hypot(one.position, first_per_second * other.position))


def _ratio(turned_deg: float, moved: float, bound: tuple[float, float | None] | None) -> float | None:
    if bound is None:
        return None
    turn, shift = bound
    by_turn = turned_deg / max(turn, EQUAL_DEG)
    return by_turn if not shift else max(by_turn, moved / shift)
