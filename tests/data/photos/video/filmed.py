"""Videos of a camera that moves over a textured wall, with some blurred frames and known content."""

from __future__ import annotations

import subprocess
from collections.abc import Sequence
from pathlib import Path

import numpy as np
from imageio_ffmpeg import get_ffmpeg_exe
from PIL import Image, ImageFilter

WIDTH, HEIGHT, RATE = 320, 240, 30


def wall(width: int, seed: int = 3) -> Image.Image:
    """Texture of many sizes, so that every place of it is known from every other."""
    rng = np.random.default_rng(seed)
    total = np.zeros((HEIGHT, width))
    for size in (2, 8, 32):
        coarse = rng.random((HEIGHT // size + 2, width // size + 2))
        picture = Image.fromarray((255 * coarse).astype(np.uint8)).resize(
            (width, HEIGHT), Image.Resampling.BICUBIC
        )
        total += np.asarray(picture, dtype=np.float64) * size**0.5
    grey = 255 * (total - total.min()) / np.ptp(total)
    return Image.fromarray(np.stack([grey, np.roll(grey, 7, 1), 255 - grey], axis=2).astype(np.uint8))


def film(
    path: Path, at_px: Sequence[float], blurred: Sequence[bool], *options: str, pixels: str = "yuv420p"
) -> None:
    """A video whose frame i shows the wall from ``at_px[i]`` on, blurred where that is said; by FFmpeg, H.264.

    ``pixels`` is FFmpeg's name of what is coded.
    """
    scene = wall(int(max(at_px)) + WIDTH + 1)
    form = ("-f", "rawvideo", "-pix_fmt", "rgb24", "-s", f"{WIDTH}x{HEIGHT}", "-r", str(RATE), "-i", "-")
    coded = ("-c:v", "libx264", "-crf", "14", "-pix_fmt", pixels, *options, str(path))
    command = [get_ffmpeg_exe(), "-y", "-v", "error", *form, *coded]
    with subprocess.Popen(command, stdin=subprocess.PIPE) as coder:
        assert coder.stdin is not None
        for place, soft in zip(at_px, blurred, strict=True):
            view = scene.transform(
                (WIDTH, HEIGHT), Image.Transform.AFFINE, (1, 0, place, 0, 1, 0), Image.Resampling.BILINEAR
            )
            coder.stdin.write((view.filter(ImageFilter.GaussianBlur(2.5)) if soft else view).tobytes())
    assert coder.returncode == 0
