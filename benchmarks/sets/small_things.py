"""Turns a set into photos of a small thing on a large black background.

    python -m benchmarks.sets.small_things SET OUT [--thing 64] [--photo 224]
    biresnerf compare OUT -o RESULT --preset fast --set start=auto

The photos of SET, a transforms file, are shrunk to `--thing` px and centred in black ones of `--photo` px.
"""

from __future__ import annotations

import argparse
import json
from pathlib import Path

import numpy as np
from PIL import Image

from biresnerf.data.formats.transforms.read_transforms import read_transforms
from biresnerf.data.model.conventions import file_from_world_from_cam


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("set", type=Path)
    parser.add_argument("out", type=Path)
    parser.add_argument("--thing", type=int, default=64)
    parser.add_argument("--photo", type=int, default=224)
    asked = parser.parse_args()
    dataset = read_transforms(asked.set)
    (asked.out / "images").mkdir(parents=True)
    frames = []
    for i, matrix in enumerate(file_from_world_from_cam(dataset.world_from_cam, np.eye(4), 1.0)):
        camera = dataset.camera_of(i)
        share = asked.thing / max(camera.width, camera.height)
        width, height = round(camera.width * share), round(camera.height * share)
        left, top = (asked.photo - width) // 2, (asked.photo - height) // 2
        photo = Image.open(dataset.frames[i].path).convert("RGBA")
        before_black = Image.alpha_composite(Image.new("RGBA", photo.size, "black"), photo).convert("RGB")
        whole = Image.new("RGB", (asked.photo, asked.photo))
        whole.paste(before_black.resize((width, height), Image.Resampling.LANCZOS), (left, top))
        whole.save(asked.out / f"images/{i:03}.png")
        lens = camera.resized(width, height).full()
        frames.append(
            {
                "file_path": f"images/{i:03}.png",
                "transform_matrix": matrix.tolist(),
                **{"fl_x": lens.fx, "fl_y": lens.fy, "cx": lens.cx + left, "cy": lens.cy + top},
            }
        )
    document = {"camera_model": "PINHOLE", "w": asked.photo, "h": asked.photo, "frames": frames}
    (asked.out / "transforms.json").write_text(json.dumps(document))


if __name__ == "__main__":
    main()
