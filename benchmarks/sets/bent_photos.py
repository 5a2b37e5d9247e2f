"""Warps a set's photos as if taken by a lens with distortion, to test finding that lens from photos alone.

    python -m benchmarks.sets.bent_photos SET OUT [--photos FOLDER]
    biresnerf refine OUT/alone -o RESULT && biresnerf evaluate RESULT OUT/truth.json

OUT gets `alone`, the photos; `lens`, the same with the true lens and no poses; and `truth.json`, both. SET is a
transforms.json with one lens; --photos names its photos in another size.
"""

from __future__ import annotations

import argparse
import json
import os
from pathlib import Path
from typing import Any

import imageio.v3 as iio
import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor
from torch.nn import functional

from biresnerf.geometry.camera.camera import Intrinsics, directions_in_cam, project
from biresnerf.geometry.camera.camera_models import Camera

ADDED = {"k1": -0.1, "k2": 0.03, "p1": 0.0008, "p2": -0.0005}
LENS = ("fl_x", "fl_y", "cx", "cy", *ADDED)
ROWS = 1 << 20  # pixels at once


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("set", type=Path)
    parser.add_argument("out", type=Path)
    parser.add_argument("--photos", type=Path, help="other sizes of the same photos, by the same names")
    asked = parser.parse_args()
    given = json.loads((asked.set / "transforms.json").read_text())
    frames = [(Path(frame["file_path"]).name, frame["transform_matrix"]) for frame in given["frames"]]
    photos = asked.photos or asked.set / "images"
    height, width = iio.imread(photos / frames[0][0]).shape[:2]
    lens = _resized(given, width, height)
    bent = lens | {name: lens[name] + more for name, more in ADDED.items()}
    grid = _source(lens, bent, width, height)
    alone, with_lens = asked.out / "alone/images", asked.out / "lens/images"
    for folder in (alone, with_lens):
        folder.mkdir(parents=True)
    for name, _ in frames:
        place = f"{Path(name).stem}.jpg"
        iio.imwrite(alone / place, _sampled(iio.imread(photos / name)[..., :3], grid), quality=95)
        os.link(alone / place, with_lens / place)
    written = {"camera_model": "OPENCV", "w": width, "h": height, **bent}
    paths = [f"images/{Path(name).stem}.jpg" for name, _ in frames]
    poses = [
        {"file_path": path, "transform_matrix": pose} for path, (_, pose) in zip(paths, frames, strict=True)
    ]
    (asked.out / "truth.json").write_text(json.dumps(written | {"frames": poses}))
    named = [{"file_path": path} for path in paths]
    (asked.out / "lens/transforms.json").write_text(json.dumps(written | {"frames": named}))


def _resized(given: dict[str, Any], width: int, height: int) -> dict[str, float]:
    """The set's lens, scaled to photos of another size."""
    x, y = width / given["w"], height / given["h"]
    scale = {"fl_x": x, "cx": x, "fl_y": y, "cy": y}
    return {name: given.get(name, 0.0) * scale.get(name, 1.0) for name in LENS}


def _source(lens: dict[str, float], bent: dict[str, float], width: int, height: int) -> Tensor:
    """Where [h, w, 2] in the original photo each pixel of the bent lens lies; -1 and 1 are its edges."""
    old, new = (
        Intrinsics.from_cameras([Camera("OPENCV", width, height, tuple(each[name] for name in LENS))])
        for each in (lens, bent)
    )
    y, x = torch.meshgrid(torch.arange(height) + 0.5, torch.arange(width) + 0.5, indexing="ij")
    found = []
    for xy in torch.stack([x, y], -1).reshape(-1, 2).double().split(ROWS):
        one = torch.zeros(len(xy), dtype=torch.int64)
        found.append(project(old, one, directions_in_cam(new, one, xy)))
    at = torch.cat(found).reshape(height, width, 2)
    return (at / torch.tensor([width, height]) * 2 - 1).float()


def _sampled(photo: NDArray[np.uint8], grid: Tensor) -> NDArray[np.uint8]:
    picture = torch.from_numpy(photo).float().permute(2, 0, 1)[None]
    shown = functional.grid_sample(
        picture, grid[None], mode="bicubic", padding_mode="border", align_corners=False
    )
    return shown[0].clamp(0, 255).round().byte().permute(1, 2, 0).numpy()


if __name__ == "__main__":
    main()
