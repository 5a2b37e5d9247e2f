"""The table of `biresnerf evaluate`: errors before and after, side by side."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from typing import Any

from biresnerf.geometry.pose_error import FrameError, PoseError, Spread
from biresnerf.geometry.trajectory_error import TrajectoryError

_ROWS = (
    ("rotation_deg", "rotation (deg)"),
    ("centre_percent", "camera centre (% of distance)"),
    ("translation", "translation t of cam_from_world"),
    ("translation_table", "  the same x100 at distance 4"),
)
_TITLES = {
    "aligned_robust": "robust",
    "aligned": "aligned",
    "own_frame": "own frame",
    "paper_compat": "paper compat",
}
_COLUMNS = ("mean", "median", "max")


@dataclass(frozen=True)
class Measured:
    """Errors of one set of poses, the images' names, and errors by how the poses were aligned."""

    names: list[str]
    error: PoseError
    frames: dict[str, FrameError]
    further: TrajectoryError

    def as_json(self) -> dict[str, Any]:
        """All of it, the worst image of each alignment by its name."""
        named = {
            key: {**frame.model_dump(), "worst": self.names[frame.worst]}
            for key, frame in self.frames.items()
        }
        return {**self.error.model_dump(), **named, **self.further.model_dump()}


def error_table(after: Measured, before: Measured | None, left_out: dict[str, int]) -> str:
    """The headline, a block for each alignment, and the figures of trajectories."""
    error = after.error
    lines = [f"{error.cameras} cameras; distance {error.reference_distance:.6g} ({error.reference})"]
    if any(left_out.values()):
        lines.append(
            f"left out: {left_out['result']} only in the result, {left_out['truth']} only in the truth"
        )
    if before is not None:
        lines.append(_headline(before, after))
    for key, frame in after.frames.items():
        lines += _block(_TITLES[key], frame, before.frames[key] if before else None, after.names[frame.worst])
    return "\n".join([*lines, "", *_further(after.further, before.further if before else None)])


def _headline(before: Measured, after: Measured) -> str:
    a, b = before.error.aligned_robust, after.error.aligned_robust
    said = (
        f"median error before -> after: rotation {a.rotation_deg.median:.3g} -> {b.rotation_deg.median:.3g} deg, "
        f"position {a.centre_percent.median:.3g} -> {b.centre_percent.median:.3g} %"
    )
    missing = after.error.cameras - before.error.cameras
    return f"{said}; {missing} cameras had no pose before" if missing else said


def _block(title: str, after: FrameError, before: FrameError | None, worst: str) -> list[str]:
    sets = {"": after} if before is None else {"before": before, "after": after}
    lines = [""]
    if before is not None:
        lines.append(" " * 32 + "".join(f"{label:>33}" for label in sets))
    lines.append(f"{title:<32}{''.join(f'{name:>11}' for name in _COLUMNS * len(sets))}   worst {worst}")
    for key, label in _ROWS:
        spreads: list[Spread] = [getattr(frame, key) for frame in sets.values()]
        cells = [f"{getattr(spread, name):>11.4g}" for spread in spreads for name in _COLUMNS]
        lines.append(f"  {label:<30}{''.join(cells)}")
    return lines


def _further(after: TrajectoryError, before: TrajectoryError | None) -> list[str]:
    sets = [one for one in (before, after) if one is not None]
    lines = [f"ATE {_way(f'{one.ate_rmse:.5g}' for one in sets)} (RMSE, in the truth's units)"]
    steps = [one for one in sets if one.rpe_translation_rmse is not None]
    if len(steps) == len(sets):
        pairs = (f"{one.rpe_translation_rmse:.5g}, {one.rpe_rotation_deg_rmse:.5g} deg" for one in steps)
        lines.append(f"RPE {_way(pairs)} (RMSE, from each image to the next)")
    lines += _areas("AUC of relative poses", [one.auc for one in sets])
    lines += _areas("  of pairs that share a view", [one.auc_covisible for one in sets])
    if any(one.auc_all != one.auc for one in sets):
        lines += _areas("  with cameras that were not placed", [one.auc_all for one in sets])
    return lines


def _areas(title: str, sets: list[dict[str, float]]) -> list[str]:
    """A line on areas under recall by threshold in degrees; none where a set has no pairs."""
    if not all(sets):
        return []
    areas = (f"@{limit}° {_way(f'{100 * one[limit]:.1f}' for one in sets)}" for limit in sets[-1])
    return [f"{title:<36}{'  '.join(areas)} (%)"]


def _way(texts: Iterable[str]) -> str:
    return " -> ".join(texts)
