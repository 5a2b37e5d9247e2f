"""A first guess of the lens of a photo without given intrinsics: EXIF's focal length, else a normal lens."""

from __future__ import annotations

import math

from biresnerf.data.model.dataset import IntrinsicsSource
from biresnerf.data.photos.image_files import ImageHeader
from biresnerf.geometry.camera.camera_models import Camera

GUESSED_FOCAL = 1.2  # of the long side, as COLMAP guesses: a field of view of 45 degrees, a normal lens
FILM_DIAGONAL_MM = math.hypot(36.0, 24.0)
PLAUSIBLE = (0.25, 20.0)  # of the long side, the focal length: angles of view of 127 to 3 degrees
# EXIF's two ways of telling the focal length; the sensor's is the finer one, and more often wrong.
AGREE = 0.1


def guess_lens(header: ImageHeader) -> tuple[Camera, IntrinsicsSource]:
    """A SIMPLE_RADIAL camera for the stored picture, without distortion, and where its focal length comes from."""
    width, height = header.width, header.height
    focal = exif_focal_px(header)
    source: IntrinsicsSource = "guessed" if focal is None else "exif"
    focal = GUESSED_FOCAL * max(width, height) if focal is None else focal
    return Camera("SIMPLE_RADIAL", width, height, (focal, width / 2, height / 2, 0.0)), source


def guess_note(source: IntrinsicsSource) -> str:
    """A note for the user on a lens that `guess_lens` found."""
    found = "taken from EXIF" if source == "exif" else "a guess"
    return f"no intrinsics are given: the focal length is {found}"


def exif_focal_px(header: ImageHeader) -> float | None:
    """Focal length in pixels of the stored picture by its EXIF; None where it says none, or none that a lens has.

    From the focal length on 35 mm film, of equal diagonal (CIPA DCG-001); or from the one in mm and the sensor's
    resolution, where that agrees or stands alone.
    """
    film = None
    if header.focal_35mm is not None:
        film = header.focal_35mm * math.hypot(header.width, header.height) / FILM_DIAGONAL_MM
    sensor = None
    if header.focal_mm is not None and header.focal_plane is not None:
        plane = header.focal_plane
        resized = header.width / plane.width if plane.width else 1.0
        sensor = header.focal_mm * plane.px_per_mm_x * resized
    both = [focal for focal in (sensor, film) if focal is not None and _plausible(focal, header)]
    if len(both) == 2 and abs(both[0] / both[1] - 1) > AGREE:
        return film
    return both[0] if both else None


def _plausible(focal: float, header: ImageHeader) -> bool:
    least, most = PLAUSIBLE
    return least <= focal / max(header.width, header.height) <= most
