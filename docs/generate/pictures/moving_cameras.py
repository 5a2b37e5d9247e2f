"""The film of the README: the finished example's cameras move with their photos from given to refined poses.

`python -m docs.generate.pictures.moving_cameras` draws it in a minute; writes docs/pictures/cameras.webp.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from PIL import Image, ImageDraw, ImageFont
from scipy.spatial.transform import Rotation

import biresnerf
from biresnerf.arrays import Array
from biresnerf.data.show.view_file import read_view_file
from biresnerf.data.show.view_pictures import read_points
from biresnerf.result import Result
from service.web_page import EXAMPLE

CAMERAS = Path(__file__).resolve().parents[2] / "pictures/cameras.webp"
MOVING, STILL, FRAME_MS = 24, 10, 60  # frames, and the duration of each
WIDTH, HEIGHT, FINE = 480, 420, 2  # px of the film, and its supersampling
GIVEN, REFINED = (150, 150, 150), (31, 119, 180)
SCENE = ("field", "tracks", "moved", "features")  # layers of points, the best first
FRUSTUM = 0.066  # its depth, relative to the eye's distance
SIGHT, FROM = 1.55, np.array([0.55, -0.95, 0.62])  # focal length per width; the eye's direction


def main() -> None:
    """Draw the film."""
    draw_cameras(biresnerf.load(EXAMPLE), CAMERAS)


def draw_cameras(result: Result, path: Path) -> None:
    """Draw the cameras with their photos, moving from given to returned poses around the scene's points."""
    way = np.linspace(0, 1, MOVING)
    eased = np.concatenate([np.zeros(STILL), way**2 * (3 - 2 * way), np.ones(2 * STILL)])
    photos, stage = _photos(result), _stage(result)
    frames = [_drawn(result, replace(result, poses=between(result, share)), photos, stage) for share in eased]
    frames[0].save(
        path, save_all=True, append_images=frames[1:], duration=FRAME_MS, loop=0, quality=62, method=6
    )


def between(result: Result, share: float) -> Array:
    """Poses [n, 4, 4] on the shortest path from the given to the returned ones."""
    start, end = result.poses_before, result.poses
    turn = Rotation.from_matrix(end[:, :3, :3] @ start[:, :3, :3].swapaxes(1, 2)).as_rotvec()
    poses = start + share * (end - start)
    poses[:, :3, :3] = Rotation.from_rotvec(share * turn).as_matrix() @ start[:, :3, :3]
    return poses


@dataclass(frozen=True)
class _Stage:
    """The viewpoint, and the scene's points as a picture."""

    eye: Array  # [3]
    eye_from_world: Array  # [3, 3]
    backdrop: Image.Image

    def project(self, points: Array) -> tuple[Array, Array]:
        """Pixels [n, 2] of the fine picture and depths [n] of points in the world."""
        seen = (points - self.eye) @ self.eye_from_world.T
        size = np.array([WIDTH, HEIGHT]) * FINE
        return seen[:, :2] / seen[:, 2:] * SIGHT * size[0] + size / 2, seen[:, 2]


def _stage(result: Result) -> _Stage:
    centres = result.poses[:, :3, 3]
    layers = {layer.source: layer for layer in read_view_file(result.folder).points}
    points, colours = read_points(result.folder, next(layers[name] for name in SCENE if name in layers))
    middle = np.median(points, axis=0)
    reach = float(np.percentile(np.linalg.norm(centres - middle, axis=1), 90))
    eye = middle + 3.1 * reach * FROM / np.linalg.norm(FROM)
    forward = (middle + np.array([0, 0, 0.16 * reach]) - eye) / (3.1 * reach)
    right = np.cross(forward, [0, 0, 1.0])
    axes = np.stack([right / np.linalg.norm(right), np.cross(forward, right), forward])
    backdrop = Image.new("RGB", (WIDTH * FINE, HEIGHT * FINE), "white")
    stage = _Stage(eye, axes, backdrop)
    draw = ImageDraw.Draw(backdrop)
    pixels, depths = stage.project(points)
    for index in np.argsort(-depths):
        x, y = pixels[index]
        draw.ellipse((x - 2.2, y - 2.2, x + 2.2, y + 2.2), fill=tuple(int(c) for c in colours[index]))
    return stage


def _photos(result: Result) -> list[Image.Image]:
    sheet = read_view_file(result.folder).contact_sheet
    assert sheet is not None
    with Image.open(result.folder / sheet.file) as opened:
        whole = opened.convert("RGB")
    wide, high = sheet.cell_width, sheet.cell_height
    places = [divmod(index, sheet.columns) for index in range(len(result.names))]
    return [whole.crop((c * wide, r * high, (c + 1) * wide, (r + 1) * high)) for r, c in places]


def _drawn(given: Result, now: Result, photos: list[Image.Image], stage: _Stage) -> Image.Image:
    picture = stage.backdrop.copy()
    cameras = [(pose, index, GIVEN) for index, pose in enumerate(given.poses_before)]
    cameras += [(pose, index, REFINED) for index, pose in enumerate(now.poses)]
    far_first = sorted(cameras, key=lambda c: -float(stage.project(c[0][None, :3, 3])[1][0]))
    for pose, index, colour in far_first:
        _draw_camera(picture, stage, pose, now, index, photos[index] if colour == REFINED else None, colour)
    picture = picture.resize((WIDTH, HEIGHT), Image.Resampling.LANCZOS)
    draw, font = ImageDraw.Draw(picture), ImageFont.load_default(15)
    for x, colour, word in ((12, GIVEN, "given"), (88, REFINED, "refined")):
        draw.rectangle((x, HEIGHT - 22, x + 14, HEIGHT - 10), outline=colour, width=3)
        draw.text((x + 20, HEIGHT - 16), word, (60, 60, 60), font, anchor="lm")
    return picture


def _draw_camera(
    picture: Image.Image,
    stage: _Stage,
    pose: Array,
    result: Result,
    index: int,
    photo: Image.Image | None,
    colour: tuple[int, int, int],
) -> None:
    camera = result.intrinsics[index]
    lens = camera.full()
    x, y = (
        np.array([0, camera.width, camera.width, 0]) - lens.cx,
        np.array([0, 0, camera.height, camera.height]) - lens.cy,
    )
    depth = FRUSTUM * float(np.linalg.norm(stage.eye - pose[:3, 3]))
    corners = np.stack([x / lens.fx, y / lens.fy, np.ones(4)], 1) * depth
    pixels, _ = stage.project(np.vstack([np.zeros(3), corners]) @ pose[:3, :3].T + pose[:3, 3])
    if photo is not None:
        _paste(picture, photo, pixels[1:])
    draw = ImageDraw.Draw(picture)
    tip, quad = tuple(pixels[0]), [tuple(pixel) for pixel in pixels[1:]]
    draw.line([*quad, quad[0]], fill=colour, width=2 * FINE if photo is not None else FINE, joint="curve")
    for corner in quad:
        draw.line([tip, corner], fill=colour, width=FINE)


def _paste(picture: Image.Image, photo: Image.Image, corners: Array) -> None:
    """Lays a photo into a quadrilateral, its corners clockwise from the upper left."""
    low, high = np.floor(corners.min(0)).astype(int), np.ceil(corners.max(0)).astype(int) + 1
    if (high - low).min() < 2 or (high - low).max() > 600:
        return
    target = corners - low
    wide, tall = photo.size
    source = np.array([[0, 0], [wide, 0], [wide, tall], [0, tall]], float)
    rows = []
    for (u, v), (s, t) in zip(target, source, strict=True):
        rows += [[u, v, 1, 0, 0, 0, -s * u, -s * v], [0, 0, 0, u, v, 1, -t * u, -t * v]]
    coefficients = np.linalg.lstsq(np.array(rows), source.ravel(), rcond=None)[0]
    size = (int(high[0] - low[0]), int(high[1] - low[1]))
    warped = photo.transform(
        size, Image.Transform.PERSPECTIVE, tuple(coefficients), Image.Resampling.BILINEAR
    )
    mask = Image.new("L", size, 0)
    ImageDraw.Draw(mask).polygon([tuple(point) for point in target], fill=255)
    picture.paste(warped, (int(low[0]), int(low[1])), mask)


if __name__ == "__main__":
    main()
