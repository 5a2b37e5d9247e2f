"""docs/pictures/conventions.svg: the camera axes of each program, and where pixels begin."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from biresnerf.data.model.conventions import OPENCV_FROM_OPENGL

Array = NDArray[np.float64]

# Each panel's title, what is beneath it, and its axes x, y, z as columns in OpenCV's axes (right, down, forward).
CAMERAS: tuple[tuple[str, str, Array], ...] = (
    ("OpenCV", "BiResNeRF, COLMAP, TUM, KITTI, Metashape", np.eye(3)),
    ("OpenGL", "nerfstudio, instant-ngp, Blender, Bundler", OPENCV_FROM_OPENGL[:3, :3]),
    ("LLFF", "poses_bounds.npy", np.array([[0.0, 1, 0], [1, 0, 0], [0, 0, -1]])),
)
COLOURS = ("#c62828", "#2e7d32", "#1565c0")
WIDTH, HEIGHT, MIDDLE = 250, 240, (92, 140)  # px, of a panel, and its camera's position
# Screen, px, of right, down and forward: a camera that looks to the right and away from the reader.
SCREEN_FROM_CAM = np.array([[36.0, 0, 72], [26, 64, -22]])
CORNERS = np.array(
    [[-0.6, -0.45, 1.2], [0.6, -0.45, 1.2], [0.6, 0.45, 1.2], [-0.6, 0.45, 1.2]]
)  # of the image
LABEL_AT = 1.22  # arrow lengths
PIXEL, COLUMNS, ROWS, GRID_AT = 36, 4, 3, (48, 76)  # px, counts, and the grid's corner on its panel


def conventions_svg() -> str:
    """The picture, with a white background so that it is readable on dark pages, too."""
    panels = [_camera(*camera) for camera in CAMERAS] + [_pixels()]
    moved = (f'<g transform="translate({i * WIDTH} 0)">{panel}</g>' for i, panel in enumerate(panels))
    arrows = "".join(
        f'<marker id="a{i}" viewBox="0 0 8 8" refX="6" refY="4" markerWidth="5" markerHeight="5" orient="auto">'
        f'<path d="M0 0L8 4L0 8z" fill="{colour}"/></marker>'
        for i, colour in enumerate(COLOURS)
    )
    size = len(panels) * WIDTH
    return (
        f'<svg xmlns="http://www.w3.org/2000/svg" viewBox="0 0 {size} {HEIGHT}" font-family="sans-serif" '
        f'font-size="12" fill="#222" role="img">\n<title>Camera axes and pixel coordinates</title>\n'
        f'<defs>{arrows}</defs>\n<rect width="{size}" height="{HEIGHT}" fill="white"/>\n'
        + "\n".join(moved)
        + "\n</svg>\n"
    )


def _camera(title: str, programs: str, axes: Array) -> str:
    corners = [_seen(corner) for corner in CORNERS]
    apex = _seen(np.zeros(3))
    lines = [f'<path d="M{apex}L{corner}" stroke="#999"/>' for corner in corners]
    outline = f'<path d="M{"L".join(corners)}Z" fill="#f1f3f5" stroke="#999"/>'
    arrows = [_axis(i, axes[:, i]) for i in range(3)]
    return _heading(title, programs) + outline + "".join(lines) + "".join(arrows)


def _axis(index: int, direction: Array) -> str:
    label = "xyz"[index]
    return (
        f'<path d="M{_seen(np.zeros(3))}L{_seen(direction)}" stroke="{COLOURS[index]}" stroke-width="2.5" '
        f'marker-end="url(#a{index})"/>' + _text(_seen(LABEL_AT * direction), label, COLOURS[index])
    )


def _pixels() -> str:
    (left, top), right, bottom = GRID_AT, COLUMNS * PIXEL, ROWS * PIXEL
    lines = [f"M{left + i * PIXEL} {top}v{bottom}" for i in range(COLUMNS + 1)]
    lines += [f"M{left} {top + i * PIXEL}h{right}" for i in range(ROWS + 1)]
    first = (left + PIXEL / 2, top + PIXEL / 2)
    dots = "".join(f'<circle cx="{x:g}" cy="{y:g}" r="3"/>' for x, y in ((left, top), first))
    texts = (
        _text(f"{left - 6} {top - 10}", "(0, 0)"),
        _text(f"{first[0] + 34:g} {first[1] + 4:g}", "(0.5, 0.5)"),
        _text(f"{left + right - 10} {top + bottom + 16}", "(width, height)"),
    )
    return (
        _heading("Pixels", "BiResNeRF, COLMAP, nerfstudio, instant-ngp")
        + f'<path d="{"".join(lines)}" stroke="#999" fill="none"/>{dots}{"".join(texts)}'
    )


def _heading(title: str, programs: str) -> str:
    return (
        f'<text x="{WIDTH / 2:g}" y="22" text-anchor="middle" font-size="16" font-weight="bold">{title}</text>'
        f'<text x="{WIDTH / 2:g}" y="40" text-anchor="middle" font-size="10.5">{programs}</text>'
    )


def _text(place: str, words: str, colour: str = "#222") -> str:
    x, y = place.split()
    return f'<text x="{x}" y="{y}" text-anchor="middle" dominant-baseline="middle" fill="{colour}">{words}</text>'


def _seen(x_in_cam: Sequence[float] | Array) -> str:
    """Where a point [3] is drawn, as SVG writes it."""
    x, y = np.array(MIDDLE) + SCREEN_FROM_CAM @ np.asarray(x_in_cam)
    return f"{x:.1f} {y:.1f}"
