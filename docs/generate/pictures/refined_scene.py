"""The pictures of the README: `python -m docs.generate.pictures.refined_scene` refines a made scene and draws what came of it.

Takes some minutes. Writes the pictures of the README, docs/pictures/cameras.webp and before_after.webp.
"""

from __future__ import annotations

import io
import tempfile
from dataclasses import replace
from pathlib import Path

import matplotlib
import matplotlib.pyplot as plt
import numpy as np
from PIL import Image, ImageDraw
from scipy.spatial.transform import Rotation

import biresnerf
from biresnerf.arrays import Array
from biresnerf.commands.poses.make_scene import make_scene
from biresnerf.data.show.view_file import read_view_file
from biresnerf.result import Result

FOLDER = Path(__file__).resolve().parents[2] / "pictures"
CAMERAS, BEFORE_AFTER = PICTURES = (FOLDER / "cameras.webp", FOLDER / "before_after.webp")
VIEWS, SIZE, NOISE, SEED = 48, 200, 0.15, 3
MOVING, STILL, FRAME_MS = 24, 12, 60  # frames, and how long each is seen
SIDE, GAP, CAPTION = 220, 8, 22  # px


def main() -> None:
    """Make a scene, refine it, draw both pictures."""
    matplotlib.use("Agg")
    with tempfile.TemporaryDirectory() as temporary:
        scene, out = Path(temporary, "scene"), Path(temporary, "out")
        make_scene(scene, "dome", own=None, views=VIEWS, size=SIZE, noise=NOISE, seed=SEED)
        result = biresnerf.refine(
            scene, out, progress=True, preset="fast", max_image_size=SIZE, orbit_frames=0
        )
        draw_cameras(result, CAMERAS)
        draw_before_after(result, BEFORE_AFTER)


def draw_cameras(result: Result, path: Path) -> None:
    """The cameras on their way from the given poses to the refined ones, as an animation."""
    way = np.linspace(0, 1, MOVING)
    eased = np.concatenate([np.zeros(STILL), way**2 * (3 - 2 * way), np.ones(2 * STILL)])
    frames = [_drawn(replace(result, poses=between(result, share))) for share in eased]
    frames[0].save(path, save_all=True, append_images=frames[1:], duration=FRAME_MS, loop=0, quality=70)


def between(result: Result, share: float) -> Array:
    """Poses [n, 4, 4] on the shortest way from the given to the returned ones."""
    start, end = result.poses_before, result.poses
    turn = Rotation.from_matrix(end[:, :3, :3] @ start[:, :3, :3].swapaxes(1, 2)).as_rotvec()
    poses = start + share * (end - start)
    poses[:, :3, :3] = Rotation.from_rotvec(share * turn).as_matrix() @ start[:, :3, :3]
    return poses


def _drawn(result: Result) -> Image.Image:
    figure = plt.figure(figsize=(5, 4), dpi=100)
    axes = figure.add_axes((-0.1, -0.15, 1.2, 1.3), projection="3d")
    result.plot_cameras(axes)
    axes.set_axis_off()
    axes.get_legend().remove()
    buffer = io.BytesIO()
    figure.savefig(buffer, format="png")
    plt.close(figure)
    return Image.open(buffer).convert("RGB")


def draw_before_after(result: Result, path: Path) -> None:
    """A photo that no model saw in training, and its renders with the given poses and with the refined ones."""
    view = next(one for one in read_view_file(result.folder).views if one.pictures.before)
    kinds = {
        "photo": "photo",
        "before": "short training, given poses",
        "after": "short training, refined poses",
        "render": "at the end of the run",
    }
    sheet = Image.new("RGB", (len(kinds) * (SIDE + GAP) - GAP, SIDE + CAPTION), "white")
    draw = ImageDraw.Draw(sheet)
    for column, (kind, caption) in enumerate(kinds.items()):
        with Image.open(result.folder / view.pictures.files()[kind]) as picture:
            large = picture.convert("RGB").resize((SIDE, SIDE), Image.Resampling.LANCZOS)
        sheet.paste(large, (column * (SIDE + GAP), 0))
        draw.text((column * (SIDE + GAP) + 4, SIDE + 2), caption, fill="black", font_size=14)
    sheet.save(path, quality=85)


if __name__ == "__main__":
    main()
