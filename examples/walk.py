"""Shared by the walks: their arguments, and pose errors before and after against the true poses."""

from __future__ import annotations

import argparse
import sys
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from biresnerf import Result
from biresnerf.commands.poses.evaluate import matched_names
from biresnerf.commands.settings_option import parse_settings
from biresnerf.data.formats.read_dataset import read_poses
from biresnerf.errors import InputError
from biresnerf.geometry.pose_error import pose_error
from biresnerf.options.refine_options import parse_options


@dataclass(frozen=True)
class Arguments:
    """Arguments of a walk.

    Attributes:
        output: a new folder for all of its files.
        of: the user's own set, with poses taken as true; None to make a set.
        views, size: number of images of the made set, and their width (px).
        options: of the refinement, by name.
    """

    output: Path
    of: Path | None
    views: int
    size: int
    options: dict[str, Any]

    @property
    def scene(self) -> Path:
        """The set with wrong or missing poses."""
        return self.output / "scene"

    @property
    def truth(self) -> Path:
        """Its true poses."""
        return self.output / "scene.truth.json"

    @property
    def refined(self) -> Path:
        """The result."""
        return self.output / "refined"


def arguments(name: str, *, views: int, size: int, **options: Any) -> Arguments:
    """The walk's defaults, overridden by the command line; a notebook has none."""
    parser = argparse.ArgumentParser(prog=f"{name}.py")
    parser.add_argument("--output", type=Path, default=Path(name), help=f"new folder (default: {name})")
    parser.add_argument("--of", type=Path, help="your own images and poses, taken as true")
    parser.add_argument("--views", type=int, default=views)
    parser.add_argument("--size", type=int, default=size, help="width of the images, px")
    parser.add_argument("--set", dest="settings", action="append", default=[], metavar="KEY=VALUE")
    given = parser.parse_args([] if _in_notebook() else None)
    options |= parse_settings(tuple(given.settings))
    try:
        parse_options(options)
    except InputError as error:
        parser.error(str(error))
    return Arguments(given.output, given.of, given.views, given.size, options)


def _in_notebook() -> bool:
    """Whether IPython runs this; that something imported it says nothing."""
    ipython = sys.modules.get("IPython")
    return ipython is not None and ipython.get_ipython() is not None


def in_words(result: Result) -> str:
    """The verdict and the warnings, a line each."""
    verdict = result.verdict.in_words() if result.verdict else ()
    return "\n".join([*verdict, *(f"warning: {warning}" for warning in result.report.warnings)])


def pose_table(truth: Path, **sets: Path) -> str:
    """Table of rotation (deg) and centre (% of the cameras' distance) errors of each set, after robust alignment."""
    true = read_poses(truth)
    lines = [
        f"{'':<10}{'poses':>8}{'rotation: median':>18}{'largest':>10}{'position: median':>18}{'largest':>10}"
    ]
    for name, path in sets.items():
        poses = read_poses(path)
        pairs = matched_names(list(poses), list(true))
        both = np.stack([poses[a] for a, _ in pairs]), np.stack([true[b] for _, b in pairs])
        error = pose_error(*both).aligned_robust
        turned, moved = error.rotation_deg, error.centre_percent
        lines.append(
            f"{name:<10}{len(pairs):>4}/{len(true):<3}{turned.median:>17.2f}°{turned.max:>9.2f}°"
            f"{moved.median:>16.2f} %{moved.max:>8.2f} %"
        )
    return "\n".join(lines)
