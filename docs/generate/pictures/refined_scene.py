"""The README's before and after: `python -m docs.generate.pictures.refined_scene` refines a synthetic still life.

Takes about ten minutes. Writes docs/pictures/before_after.webp, the same view for the start page, and the film
docs/pictures/flight.webp.
"""

from __future__ import annotations

import shutil
import tempfile
from pathlib import Path

import imageio.v2 as imageio
import numpy as np
from PIL import Image, ImageDraw, ImageFont

import biresnerf
from biresnerf.arrays import Array
from biresnerf.commands.poses.make_scene import make_scene
from biresnerf.data.show.view_file import read_view_file
from biresnerf.geometry.pose_error import rotation_between_deg
from biresnerf.result import Result
from biresnerf.write.output_folder import ORBIT
from docs.generate.pictures.example import keep_unseen
from service.web_page import EXAMPLE

PICTURES = Path(__file__).resolve().parents[2] / "pictures"
BEFORE_AFTER, FLIGHT = PICTURES / "before_after.webp", PICTURES / "flight.webp"
VIEWS, SIZE, NOISE, SEED = 40, 512, 0.03, 3
OPTIONS = {"preset": "fast", "max_image_size": SIZE, "orbit_frames": 0}
SIDE, GAP, CAPTION, CROP = 340, 8, 26, 120  # px; the crop is of the render
FRAMES, FRAME_MS, FRAME_SIDE = 60, 90, 256


def main() -> None:
    """Make a scene, refine it, draw the picture."""
    with tempfile.TemporaryDirectory() as temporary:
        scene, out = Path(temporary, "scene"), Path(temporary, "out")
        make_scene(scene, "still-life", own=None, views=VIEWS, size=SIZE, noise=NOISE, seed=SEED)
        result = biresnerf.refine(scene, out, progress=True, **OPTIONS)
        straight = shutil.copytree(scene, Path(temporary, "straight"))
        shutil.copyfile(out / "transforms.json", straight / "transforms.json")
        still = {**OPTIONS, "start": "given", "fixed": result.names, "verdict": False, "orbit_frames": FRAMES}
        given, refined = (
            biresnerf.refine(poses, Path(temporary, name), progress=True, **still)
            for poses, name in ((scene, "given"), (straight, "refined"))
        )
        turned = float(np.median(rotation_between_deg(result.poses_before, result.poses)))
        draw_before_after(given, refined, turned, BEFORE_AFTER)
        draw_flight(given.folder / ORBIT, refined.folder / ORBIT, FLIGHT)


def draw_before_after(given: Result, refined: Result, turned: float, path: Path) -> None:
    """Draw one unseen view of fields trained equally long at fixed given and refined poses, beside its photo.

    Below, the part in which the renders differ most, enlarged.
    """
    views = {view.image: view for view in read_view_file(refined.folder).views if view.held_out}
    before = next(view for view in read_view_file(given.folder).views if view.image in views)
    after = views[before.image]
    pictures = {}
    for name, file in (
        ("given", given.folder / before.pictures.render),
        ("refined", refined.folder / after.pictures.render),
        ("photo", refined.folder / after.pictures.photo),
    ):
        with Image.open(file) as opened:
            pictures[name] = opened.convert("RGB")
    keep_unseen(pictures, EXAMPLE)
    captions = (f"given poses, {turned:.1f}° off", "refined poses", "photo, not used in training")
    x, y = most_different(*(np.asarray(pictures[kind], np.float64) for kind in ("given", "refined")))
    sheet = Image.new("RGB", (3 * (SIDE + GAP) - GAP, CAPTION + 2 * SIDE + GAP), "white")
    draw, font = ImageDraw.Draw(sheet), ImageFont.load_default(17)
    for column, (picture, caption) in enumerate(zip(pictures.values(), captions, strict=True)):
        left = column * (SIDE + GAP)
        draw.text((left + 4, CAPTION // 2), caption, "black", font, anchor="lm")
        scale = SIDE / picture.width
        sheet.paste(picture.resize((SIDE, SIDE), Image.Resampling.LANCZOS), (left, CAPTION))
        corner = (left + x * scale, CAPTION + y * scale)
        draw.rectangle((*corner, *(each + CROP * scale for each in corner)), outline=(31, 119, 180), width=2)
        crop = picture.crop((x, y, x + CROP, y + CROP)).resize((SIDE, SIDE), Image.Resampling.LANCZOS)
        sheet.paste(crop, (left, CAPTION + SIDE + GAP))
    sheet.save(path, quality=82, method=6)


def draw_flight(given: Path, refined: Path, path: Path) -> None:
    """Draw two films side by side, as an animated picture."""
    frames = []
    for pair in zip(imageio.get_reader(given), imageio.get_reader(refined), strict=True):
        frame = Image.new("RGB", (2 * FRAME_SIDE + GAP, CAPTION + FRAME_SIDE), "white")
        draw, font = ImageDraw.Draw(frame), ImageFont.load_default(17)
        for column, (picture, caption) in enumerate(zip(pair, ("given poses", "refined poses"), strict=True)):
            left = column * (FRAME_SIDE + GAP)
            draw.text((left + 4, CAPTION // 2), caption, "black", font, anchor="lm")
            small = Image.fromarray(picture).resize((FRAME_SIDE, FRAME_SIDE), Image.Resampling.LANCZOS)
            frame.paste(small, (left, CAPTION))
        frames.append(frame)
    frames[0].save(
        path, save_all=True, append_images=frames[1:], duration=FRAME_MS, loop=0, quality=62, method=6
    )


def most_different(one: Array, other: Array) -> tuple[int, int]:
    """The upper left corner of the square of `CROP` px in which two pictures [h, w, 3] differ most."""
    sums = np.pad(np.abs(one - other).sum(axis=2), ((1, 0), (1, 0))).cumsum(axis=0).cumsum(axis=1)
    within = sums[CROP:, CROP:] - sums[:-CROP, CROP:] - sums[CROP:, :-CROP] + sums[:-CROP, :-CROP]
    y, x = np.unravel_index(within.argmax(), within.shape)
    return int(x), int(y)


if __name__ == "__main__":
    main()
