"""Pictures for people: renders beside photos, where they differ, how deep they see, and an orbit video."""

from __future__ import annotations

import re
from collections.abc import Iterable, Mapping, Sequence
from contextlib import closing
from pathlib import Path

import imageio.v2 as imageio
import numpy as np
from numpy.typing import NDArray
from PIL import Image

from biresnerf.data.model.atomic_file import whole_file

# The mean absolute difference over the channels (0 to 1) that the brightest colour stands for, in all
# pictures.
DIFFERENCE_AT_TOP = 0.25
ORBIT_FRAMES_PER_S = 24
_NOTHING = np.array([0, 0, 0], dtype=np.uint8)
# Viridis at nine even places: even steps look even, also without colour vision.
_RAMP = np.array(
    [
        *((68, 1, 84), (71, 44, 122), (59, 81, 139), (44, 113, 142), (33, 144, 141)),
        *((39, 173, 129), (92, 200, 99), (170, 220, 50), (253, 231, 37)),
    ],
    dtype=np.float64,
)


def picture_stems(names: Sequence[str]) -> list[str]:
    """A file name stem for each image name, without folders and extension, all different from each other."""
    stems: list[str] = []
    taken: set[str] = set()
    for name in names:
        plain = re.sub(r"\.(png|jpe?g|webp|tiff?|bmp)$", "", name, flags=re.IGNORECASE)
        parts = [part for part in re.split(r"[/\\]+", plain) if part not in ("", ".", "..")]
        # Long names would not fit a file system once endings are added; control characters fit nowhere.
        stem = re.sub(r"[\x00-\x1f:*?\"<>|]", "_", "_".join(parts))[-100:] or "image"
        number, unique = 2, stem
        while unique.casefold() in taken:
            unique, number = f"{stem}_{number}", number + 1
        taken.add(unique.casefold())
        stems.append(unique)
    return stems


def write_view(
    folder: Path,
    stem: str,
    *,
    render: NDArray[np.generic],
    photo: NDArray[np.generic],
    depth: NDArray[np.floating] | None = None,
) -> list[Path]:
    """Writes ``<stem>_render.png``, ``_photo.png``, ``_difference.png`` and, where given, ``_depth.png``.

    The difference is the mean absolute one over the channels, from dark (none) to yellow (a quarter of the
    full range and more). Depth goes from yellow (near) to dark (far); black is nothing.

    Args:
        folder: made where it is missing.
        stem: see `picture_stems`.
        render, photo: [h, w, 3], of one size; uint8, or floats from 0 to 1.
        depth: [h, w], along the optical axis, in any unit; not finite or not positive where there is nothing.

    Returns:
        the files written.

    Raises:
        ValueError: shapes differ, or colours are not finite.
    """
    rendered, taken = _bytes(render), _bytes(photo)
    if rendered.shape != taken.shape or (depth is not None and depth.shape != rendered.shape[:2]):
        raise ValueError(f"render {rendered.shape}, photo {taken.shape} and depth must be of one size")
    error = np.abs(rendered.astype(np.float64) - taken).mean(axis=2) / 255.0
    pictures = {"render": rendered, "photo": taken, "difference": ramp_colours(error / DIFFERENCE_AT_TOP)}
    if depth is not None:
        pictures["depth"] = depth_picture(depth)
    return write_pictures(folder, stem, pictures)


def write_pictures(folder: Path, stem: str, pictures: Mapping[str, NDArray[np.generic]]) -> list[Path]:
    """Writes ``<stem>_<kind>.png`` for each picture [h, w, 3], uint8 or floats from 0 to 1; returns the files."""
    written = []
    for kind, picture in pictures.items():
        path = folder / f"{stem}_{kind}.png"
        with whole_file(path) as temporary:
            Image.fromarray(_bytes(picture)).save(temporary)
        written.append(path)
    return written


def ramp_colours(values: NDArray[np.floating]) -> NDArray[np.uint8]:
    """Colours uint8 [..., 3] of values, 0 (dark violet) to 1 (yellow); values outside take the ends."""
    position = np.clip(values, 0.0, 1.0) * (len(_RAMP) - 1)
    below = np.minimum(position.astype(np.int64), len(_RAMP) - 2)
    share = (position - below)[..., None]
    return np.rint(_RAMP[below] * (1 - share) + _RAMP[below + 1] * share).astype(np.uint8)


def depth_picture(depth: NDArray[np.floating]) -> NDArray[np.uint8]:
    """Colours uint8 [h, w, 3] of a depth map; the ramp ends at its 2nd and 98th percentile."""
    there = np.isfinite(depth) & (depth > 0)
    if not there.any():
        return np.broadcast_to(_NOTHING, (*depth.shape, 3)).copy()
    near, far = np.percentile(depth[there], [2.0, 98.0])
    share = (np.where(there, depth, far) - near) / max(far - near, 1e-12)
    return np.where(there[..., None], ramp_colours(1.0 - share), _NOTHING)


def write_orbit(path: Path, frames: Iterable[NDArray[np.generic]]) -> int:
    """Writes a video (H.264, mp4, plays in browsers) of frames [h, w, 3] of one size; uint8, or floats 0 to 1.

    Frames are taken one by one, so that they may be rendered as they are written. An odd width or height gets
    its last column or row twice: the format needs even sizes.

    Returns:
        the number of frames written.

    Raises:
        ValueError: there is no frame, or one is of another size, or not finite.
    """
    count, shape = 0, None
    with whole_file(path) as temporary:
        writer = imageio.get_writer(
            temporary,
            format="FFMPEG",
            mode="I",
            fps=ORBIT_FRAMES_PER_S,
            codec="libx264",
            pixelformat="yuv420p",
            quality=8,
            macro_block_size=2,
            output_params=["-movflags", "+faststart"],
        )
        # closing(): the writer's own `with` leaves ffmpeg running where an error ends it.
        with closing(writer):
            for frame in frames:
                picture = _bytes(frame)
                if shape not in (None, picture.shape):
                    raise ValueError(f"frame {count} is {picture.shape}, those before it {shape}")
                shape = picture.shape
                even = ((0, shape[0] % 2), (0, shape[1] % 2), (0, 0))
                writer.append_data(np.pad(picture, even, mode="edge"))
                count += 1
        if count == 0:
            raise ValueError("an orbit needs at least one frame")
    return count


def _bytes(picture: NDArray[np.generic]) -> NDArray[np.uint8]:
    if picture.ndim != 3 or picture.shape[2] != 3:
        raise ValueError(f"a picture must be [h, w, 3], not {picture.shape}")
    if picture.dtype == np.uint8:
        return np.ascontiguousarray(picture, dtype=np.uint8)
    values = picture.astype(np.float64)
    if not np.isfinite(values).all():
        raise ValueError("a picture holds NaN or infinite values")
    return np.rint(255.0 * np.clip(values, 0.0, 1.0)).astype(np.uint8)
