"""What a job of many photos takes besides its steps: ``python -m benchmarks.speed.large_set [--photos 250,500,1000]``.

Makes a set of JPEG photos of 12 MP (small renders of the scene of `make-scene`, enlarged) with noisy poses, and refines
every number of them in a process of its own with few steps. Prints the processor seconds of each part, so that other
work on the machine does not count, and the most memory that the process held. The photos are removed at the end.
``--profile`` prints the slowest functions of each run.
"""

from __future__ import annotations

import argparse
import json
import subprocess
import sys
import tempfile
from collections.abc import Sequence
from pathlib import Path

import numpy as np
from PIL import Image

from benchmarks.speed.large_set_run import NUMBERS, PARTS, measured
from biresnerf.data.model.conventions import file_from_world_from_cam
from biresnerf.data.synthetic.scene import SHAPES, random_textures, render_shapes, synthetic_cameras
from biresnerf.geometry.perturb import perturb_poses

WIDTH, HEIGHT = 4000, 3000
RENDERED = 20  # full px to a rendered one
FOCAL = 1.2  # of the photos' width
NOISE = 0.05
QUALITY = 85


def make_set(folder: Path, counts: Sequence[int]) -> dict[int, Path]:
    """Photos for the largest of the counts, and a transforms file for each count, of photos spread over all."""
    most = max(counts)
    true, textures = synthetic_cameras(most, seed=0), random_textures(len(SHAPES), seed=0)
    small = (WIDTH // RENDERED, HEIGHT // RENDERED)
    (folder / "images").mkdir(parents=True)
    for i, pose in enumerate(true):
        rgba, _ = render_shapes(SHAPES, textures, pose, *small, FOCAL * small[0])
        share = rgba[..., 3:] / 255
        colour = np.rint(rgba[..., :3] * share + 255 * (1 - share)).astype(np.uint8)
        photo = Image.fromarray(colour).resize((WIDTH, HEIGHT), Image.Resampling.BILINEAR)
        photo.save(folder / "images" / f"{i:04}.jpg", quality=QUALITY)
    given = file_from_world_from_cam(perturb_poses(true, NOISE, seed=1), np.eye(4), 1.0)
    lens = {"w": WIDTH, "h": HEIGHT, "fl_x": FOCAL * WIDTH, "cx": WIDTH / 2, "cy": HEIGHT / 2}
    files = {}
    for count in counts:
        frames = [
            {"file_path": f"images/{i:04}.jpg", "transform_matrix": given[i].tolist()}
            for i in np.linspace(0, most - 1, count).round().astype(int).tolist()
        ]
        files[count] = folder / f"transforms_{count}.json"
        files[count].write_text(json.dumps({**lens, "frames": frames}))
    return files


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--photos", default="250,500,1000", help="How many, separated by commas.")
    parser.add_argument("--size", type=int, default=200, help="Long side of the photos at work, px.")
    parser.add_argument("--steps", type=int, default=200)
    parser.add_argument("--start", default="given", help="As the option of `biresnerf refine`.")
    parser.add_argument("--threads", type=int, default=0)
    parser.add_argument(
        "--profile", action="store_true", help="Print the slowest functions of each run, too."
    )
    parser.add_argument("--one", type=Path, help=argparse.SUPPRESS)  # the transforms file of a run of its own
    asked = parser.parse_args()
    settings = {"start": asked.start, "steps": asked.steps, "max_image_size": asked.size}
    settings |= {"threads": asked.threads} if asked.threads else {}
    if asked.one:
        print(json.dumps(measured(asked.one, settings, profile=asked.profile)))
        return
    counts = [int(count) for count in asked.photos.split(",")]
    found = {}
    with tempfile.TemporaryDirectory(prefix="biresnerf-large-set-") as folder:
        for count, path in make_set(Path(folder), counts).items():
            command = [sys.executable, "-m", "benchmarks.speed.large_set", *sys.argv[1:], "--one", str(path)]
            answer = subprocess.run(command, check=True, stdout=subprocess.PIPE, text=True)
            found[count] = json.loads(answer.stdout.splitlines()[-1])
            print(f"{count} photos: {found[count]}", file=sys.stderr, flush=True)
    print("| |" + "".join(f" {count} photos |" for count in counts))
    print("|---|" + "---|" * len(counts))
    for name in (*PARTS, "steps", "everything else", "the whole job"):
        print(f"| {name}, s |" + "".join(f" {found[count][name]:.1f} |" for count in counts))
    for name in NUMBERS:
        print(f"| {name} |" + "".join(f" {found[count][name]:.0f} |" for count in counts))


if __name__ == "__main__":
    main()
