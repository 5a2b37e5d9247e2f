"""The plot of `biresnerf evaluate`: each image's errors, before and after."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from biresnerf.data.model.atomic_file import whole_file
from biresnerf.errors import InputError, needs_extra
from biresnerf.geometry.pose_error import CameraErrors

SUFFIXES = (".png", ".svg", ".pdf")
COLOURS = {"before": "0.6", "after": "tab:blue"}
WIDTH, HEIGHT = 8.0, 5.0  # inches


def refuse_other_files(path: Path) -> None:
    """Raises InputError ``invalid_options`` where no plot can be written to ``path``."""
    if path.suffix.lower() not in SUFFIXES:
        raise InputError(
            "invalid_options",
            "is no name of a plot.",
            where=str(path),
            hint=f"End it with {', '.join(SUFFIXES)}.",
        )


def plot_errors(path: Path, sets: dict[str, CameraErrors], distance: float, title: str) -> None:
    """Writes the plot: rotation errors above, errors of the centres in percent of ``distance`` below.

    Args:
        sets: ``before`` and ``after``, or one of them, of the same images in the same order; NaN where there is none.

    Raises:
        InputError: ``extra_missing`` without matplotlib.
    """
    with needs_extra("plots"):
        from matplotlib import rc_context
        from matplotlib.figure import Figure
    figure = Figure(figsize=(WIDTH, HEIGHT), layout="constrained")
    rotation, centre = figure.subplots(2, 1, sharex=True)
    for label, errors in sets.items():
        for axes, values, unit in (
            (rotation, errors.rotation_deg, "°"),
            (centre, 100 * errors.centre / distance, " %"),
        ):
            middle = float(np.nanmedian(values))
            style = {"color": COLOURS[label], "lw": 1}
            axes.plot(values, marker=".", label=f"{label}: median {middle:.3g}{unit}", **style)
            axes.axhline(middle, linestyle=":", **style)
    rotation.set(ylabel="rotation error (°)", yscale="log")
    rotation.set_title(title, loc="left", fontsize=10)
    centre.set(ylabel="position error (% of distance)", yscale="log", xlabel="image")
    for axes in (rotation, centre):
        axes.grid(alpha=0.3)
        axes.yaxis.set_major_formatter("{x:g}")
        axes.legend(loc="lower right", bbox_to_anchor=(1, 1), ncols=2, frameon=False)
    with rc_context({"svg.fonttype": "none", "svg.hashsalt": "biresnerf"}), whole_file(path) as temporary:
        figure.savefig(temporary, dpi=120, format=path.suffix[1:].lower())
