"""Checks of a pose that a file gives: shape, finiteness, and that it is a rigid motion."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from biresnerf.data.model.untrusted_file import refuse_not_finite
from biresnerf.errors import InputError
from biresnerf.geometry.rigid import motion_of

ROTATION_REFUSED = 1e-2  # a singular value farther than this from 1 is a scaling or a shear, not rounding
ROTATION_WARNED = 1e-4  # files with 5 to 6 digits stay below it
MAX_COORDINATE = 1e9  # map coordinates in millimetres fit; beyond it float32 maths says nothing
MAX_POINT_COORDINATE = 1e15  # points triangulated far away are no fault; their squares fit into float32
_REFLECTION_HINT = "Flip whole axes of the world instead (a rotation), or export with another axis setting."


def _numbers(value: Any, where: str) -> NDArray[np.float64]:
    rows = value if isinstance(value, list) else None
    if (
        rows is not None
        and len(rows) in (3, 4)
        and all(isinstance(row, list) and len(row) == 4 for row in rows)
    ):
        flat = [item for row in rows for item in row]
        if all(isinstance(item, int | float) and not isinstance(item, bool) for item in flat):
            try:
                return np.array(rows, dtype=np.float64)
            except OverflowError:
                pass
        raise InputError(
            "pose_shape",
            "holds something that is not a number.",
            where=where,
            hint="Give 4 rows of 4 numbers.",
        )
    raise InputError(
        "pose_shape",
        "is not a matrix of 4 x 4 (or 3 x 4) numbers.",
        where=where,
        hint="Give the camera-to-world matrix as 4 rows of 4 numbers.",
    )


def rigid_matrix(value: Any, where: str) -> tuple[NDArray[np.float64], float]:
    """A rigid motion float64 [4, 4] from a JSON value of 3 or 4 rows of 4 numbers.

    A last row of (0, 0, 0, s) divides the matrix by s. The rotation is projected to the nearest one. Returns also how
    far it was from one: the largest deviation of a singular value from 1.

    Raises:
        InputError: ``pose_shape``, ``pose_not_finite`` or ``pose_not_rotation``; ``where`` names file and
            field.
    """
    rows = _numbers(value, where)
    refuse_not_finite(rows, where, "Remove the frame or export it again.")
    if len(rows) == 4 and rows[3, 3] > 0.0 and not rows[3, :3].any():
        rows = rows / rows[3, 3]  # homogeneous: any multiple of the matrix is the same motion
    if len(rows) == 4 and not np.allclose(rows[3], [0.0, 0.0, 0.0, 1.0], rtol=0.0, atol=1e-6):
        raise InputError(
            "pose_shape",
            f"the last row is {rows[3].tolist()}, not [0, 0, 0, 1].",
            where=where,
            hint="Give row vectors of a camera-to-world matrix; it may be transposed.",
        )
    if np.abs(rows[:3, 3]).max() > MAX_COORDINATE:
        raise InputError(
            "pose_out_of_range",
            f"the position is farther than {MAX_COORDINATE:g} from the origin.",
            where=where,
            hint="Move the scene's origin near the scene.",
        )
    rotation, deviation = _nearest_rotation(rows[:3, :3], where)
    return motion_of(rotation, rows[:3, 3]), deviation


def _nearest_rotation(block: NDArray[np.float64], where: str) -> tuple[NDArray[np.float64], float]:
    u, stretch, vt = np.linalg.svd(block)
    deviation = float(np.abs(stretch - 1.0).max())
    if deviation > ROTATION_REFUSED:
        if stretch[2] > 1e-12 and stretch[0] < (1.0 + ROTATION_REFUSED) * stretch[2]:
            what = f"the rotation is scaled by {stretch.mean():.6g}."
            hint = "Divide the 3 x 3 block by that factor; put a change of scale into the positions alone."
        else:
            what = "the upper left 3 x 3 block is no rotation (its columns are not unit and orthogonal)."
            hint = "Export the camera-to-world matrix again; rows and columns may be mixed up."
        raise InputError("pose_not_rotation", what, where=where, hint=hint)
    if np.linalg.det(block) < 0.0:
        raise InputError(
            "pose_not_rotation", "the rotation mirrors (determinant -1).", where=where, hint=_REFLECTION_HINT
        )
    return u @ vt, deviation


def refuse_coinciding(poses: Sequence[NDArray[np.float64]], where: str) -> None:
    """Raises InputError ``poses_coincide`` where ``poses`` [n, 4, 4], two or more, all stand at one point."""
    if len(poses) < 2:
        return
    centres = np.stack(poses)[:, :3, 3]
    if np.ptp(centres, axis=0).max() <= 1e-9 * max(1.0, float(np.abs(centres).max())):
        raise InputError(
            "poses_coincide",
            "all cameras stand at one point, so there is no parallax to work from.",
            where=where,
            hint="Give poses with different positions, or the images alone to have them found by COLMAP.",
        )
