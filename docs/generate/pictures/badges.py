"""docs/pictures/badge_*.svg: version, Python and licence, as pictures for the README."""

from __future__ import annotations

import re
import tomllib
from collections.abc import Callable
from functools import partial
from html import escape
from pathlib import Path

from biresnerf import __version__

HEIGHT, PER_LETTER, MARGIN = 20, 6.7, 7  # px


def badges(root: Path) -> dict[Path, Callable[[], str]]:
    """Each badge's file, with its writer."""
    project = tomllib.loads((root / "pyproject.toml").read_text("utf-8"))["project"]
    pythons = re.findall(r"Python :: (3\.\d+)", "\n".join(project["classifiers"]))
    python = f"{pythons[0]} to {pythons[-1]}"
    said = {"version": __version__, "python": python, "licence": project["license"]}
    return {
        root / f"docs/pictures/badge_{name}.svg": partial(badge, name, value) for name, value in said.items()
    }


def badge(name: str, value: str) -> str:
    """A badge with two words."""
    left, right = (round(len(text) * PER_LETTER) + 2 * MARGIN for text in (name, value))
    return (
        f'<svg xmlns="http://www.w3.org/2000/svg" width="{left + right}" height="{HEIGHT}" role="img" '
        f'aria-label="{escape(name)}: {escape(value)}" font-family="Verdana, sans-serif" font-size="11" fill="#fff" '
        f'text-anchor="middle"><rect width="{left}" height="{HEIGHT}" fill="#444"/>'
        f'<rect x="{left}" width="{right}" height="{HEIGHT}" fill="#1f77b4"/>'
        f'<text x="{left / 2:g}" y="14">{escape(name)}</text>'
        f'<text x="{left + right / 2:g}" y="14">{escape(value)}</text></svg>\n'
    )
