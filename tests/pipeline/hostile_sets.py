"""Small sets in each format with numbers replaced by extreme ones, or the whole scene by a tiny or huge one."""

from __future__ import annotations

import re
import shutil
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np

from biresnerf.data.formats.colmap.write_text import write_colmap_text
from biresnerf.data.formats.convert import convert
from biresnerf.data.formats.read_dataset import read_dataset
from biresnerf.data.model.result_model import model_of_poses
from biresnerf.data.synthetic.scene import synthetic_cameras, write_synthetic_scene
from biresnerf.geometry.perturb import perturb_poses
from tests.data.points.test_refined_points import seen_model

VIEWS, SIZE = 5, 24
FORMATS = ("colmap-text", "transforms", "instant-ngp", "tum", "kitti", "bundler", "llff", "poses", "csv")
EXTREMES = (
    *(
        "0",
        "-0.0",
        "1",
        "-1",
        "1e-320",
        "1e-45",
        "1e-30",
        "1e-12",
        "1e-9",
        "-1e-9",
        "1e-3",
        "1e3",
        "1e6",
        "-1e6",
    ),
    *(
        "1e9",
        "-1e9",
        "9.9e8",
        "1e12",
        "1e15",
        "1e19",
        "1e20",
        "3.4e38",
        "1e39",
        "1e154",
        "1e160",
        "1e308",
        "-1e308",
    ),
    *("127", "255", "256", "65536", "2147483647", "2147483648", "4294967294", "4294967295", "4294967296"),
    *("9007199254740993", "9223372036854775806", "9223372036854775807", "18446744073709551615"),
)
SUFFIXES = (".txt", ".json", ".out", ".npy", ".csv")
SCALES = (1.0, 1e-300, 1e-160, 1e-40, 1e-20, 1e-12, 1e-9, 1e-6, 1e6, 1e8)
_NUMBER = re.compile(r"(?<![\w./])-?\d+(?:\.\d+)?(?:e[+-]?\d+)?(?![\w./])", re.IGNORECASE)
Change = tuple[tuple[int, int, int], str]


def plain_set(folder: Path, form: str, scale: float, shift: float) -> Path:
    """The set in one format, in a new folder; the scene is ``scale`` times as large, and ``shift`` units away."""
    rendered = folder.parent / "rendered"
    if not rendered.exists():
        write_synthetic_scene(rendered, VIEWS, SIZE, seed=3)
    given = read_dataset(rendered)
    (folder / "model/images").mkdir(parents=True)
    names = [frame.path.name for frame in given.frames]
    for frame in given.frames:
        shutil.copy(frame.path, folder / "model/images" / frame.path.name)
    truth = synthetic_cameras(VIEWS, 3)
    xyz = np.random.default_rng(0).uniform(-0.6, 0.6, (12, 3))
    model = seen_model(1, truth, xyz, camera=given.cameras[0])
    noisy = perturb_poses(truth, 0.01, 1)
    noisy[:, :3, 3] = noisy[:, :3, 3] * scale + shift
    poses = model_of_poses(names, [given.cameras[0]], [0] * VIEWS, noisy).images
    images = {
        number: replace(image, name=names[number - 1], cam_from_world=poses[number].cam_from_world)
        for number, image in model.images.items()
    }
    points = replace(model.points, xyz=xyz * scale + shift)
    write_colmap_text(replace(model, images=images, points=points), folder / "model/sparse/0")
    if form == "colmap-text":
        return folder / "model"
    convert(read_dataset(folder / "model"), [form], folder / "set", "copy", (0.5 * scale, 9.0 * scale))
    return folder / "set"


def change(folder: Path, changes: Sequence[Change]) -> None:
    """Replaces numbers of the pose files.

    Each change names a file, a line of it that has numbers, and one of these, by their places; and the new number.
    """
    for (file, line, number), text in changes:
        paths = [path for path in sorted(folder.rglob("*")) if path.suffix in SUFFIXES]
        path = paths[file % len(paths)]
        if path.suffix == ".npy":
            rows = np.load(path)
            rows.flat[line % rows.size] = float(text)
            np.save(path, rows)
            continue
        lines = path.read_text().splitlines(keepends=True)
        places = [
            n for n, content in enumerate(lines) if _NUMBER.search(content) and not content.startswith("#")
        ]
        if not places:
            continue
        at = places[line % len(places)]
        found = list(_NUMBER.finditer(lines[at]))
        start, end = found[number % len(found)].span()
        lines[at] = lines[at][:start] + text + lines[at][end:]
        path.write_text("".join(lines))
