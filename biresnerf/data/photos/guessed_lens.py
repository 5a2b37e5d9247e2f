"""A first guess of a lens that is not given (EXIF's focal length, else a normal lens), and doubts of one that is."""

from __future__ import annotations

import math
from collections import defaultdict
from dataclasses import replace

import numpy as np

from biresnerf.data.model.dataset import Dataset, IntrinsicsSource
from biresnerf.data.model.part_of_set import with_frames
from biresnerf.data.photos.image_files import ImageHeader, read_header
from biresnerf.errors import InputError
from biresnerf.geometry.camera.camera_models import Camera, FullParameters
from biresnerf.geometry.camera.lens import lens_problem

GUESSED_FOCAL = 1.2  # of the long side, as COLMAP guesses: a field of view of 45 degrees, a normal lens
FILM_DIAGONAL_MM = math.hypot(36.0, 24.0)
PLAUSIBLE = (0.25, 20.0)  # of the long side, the focal length: angles of view of 127 to 3 degrees
# EXIF's two ways of stating the focal length; the sensor's is the finer one, and more often wrong.
AGREE = 0.1
CONTRADICTS = 1.5  # by this factor EXIF's focal length and a given one differ, and not for a crop or a zoom
MOST_APART = 0.4  # logarithms of focal lengths that were guessed of one lens
MOST_VIEW_DEG = 150.0  # lenses that keep straight lines straight see 130 degrees or so
LEAST_MM = 2.0  # lenses of phones have that much; shares of the width are smaller
LEAST_SIDE = 16  # px; in smaller photos the first pixel is no corner


def guess_lens(header: ImageHeader) -> tuple[Camera, IntrinsicsSource]:
    """A camera for the stored picture, and where it comes from.

    It is as the drone's maker measured it, where the picture's XMP says so and EXIF agrees. Else it is SIMPLE_RADIAL,
    without distortion.
    """
    width, height = header.width, header.height
    focal = exif_focal_px(header)
    measured = _as_its_maker_measured(header, focal)
    if measured is not None:
        return measured, "maker"
    source: IntrinsicsSource = "guessed" if focal is None else "exif"
    focal = GUESSED_FOCAL * max(width, height) if focal is None else focal
    return Camera("SIMPLE_RADIAL", width, height, (focal, width / 2, height / 2, 0.0)), source


def _as_its_maker_measured(header: ImageHeader, exif_px: float | None) -> Camera | None:
    """None where EXIF's focal length shows that another picture was measured, or where no lens is like that."""
    lens = header.maker_lens
    if lens is None:
        return None
    scale = header.width / lens.width if lens.width else 1.0
    fx, fy, cx, cy = (scale * each for each in lens[1:5])
    if not all(_plausible(focal, header) for focal in (fx, fy)):
        return None
    if exif_px is not None and abs(math.sqrt(fx * fy) / exif_px - 1) > AGREE:
        return None
    place = header.width / 2 + cx, header.height / 2 + cy
    bent = lens.k1, lens.k2, lens.p1, lens.p2, lens.k3
    camera = Camera("FULL_OPENCV", header.width, header.height, (fx, fy, *place, *bent, 0.0, 0.0, 0.0))
    return None if lens_problem(camera.full(), camera.width, camera.height) else camera


def guess_note(source: IntrinsicsSource) -> str:
    """A note for the user on a lens that is not given."""
    if source == "maker":
        return "no intrinsics are given: the lens is as its maker measured it, by the photos' XMP"
    found = {"exif": "taken from EXIF", "predicted": "what a network predicted"}.get(source, "a guess")
    return f"no intrinsics are given: the focal length is {found}"


def with_shared_predictions(dataset: Dataset) -> Dataset:
    """The set with one SIMPLE_RADIAL camera in place of predicted ones of the same size and EXIF lens.

    It has their medians. Predictions that differ as much as guesses do are of different lenses.
    """
    alike: dict[tuple[int, int, tuple[str, ...]], list[int]] = defaultdict(list)
    for row, frame in enumerate(dataset.frames):
        if dataset.source_of_intrinsics(frame.camera) == "predicted":
            header = read_header(frame.path, frame.name)
            camera = dataset.camera_of(row)
            alike[camera.width, camera.height, header.taken_with].append(row)
    cameras, sources = list(dataset.cameras), list(dataset.intrinsics_sources)
    frames = list(dataset.frames)
    for (width, height, _), rows in alike.items():
        full = [dataset.camera_of(row).full() for row in rows]
        focal = np.array([math.sqrt(lens.fx * lens.fy) for lens in full])
        if np.abs(np.log(focal / np.median(focal))).max() > MOST_APART:
            continue
        cx, cy = np.median([(lens.cx, lens.cy) for lens in full], axis=0).tolist()
        cameras.append(Camera("SIMPLE_RADIAL", width, height, (float(np.median(focal)), cx, cy, 0.0)))
        sources.append("predicted")
        for row in rows:
            frames[row] = replace(frames[row], camera=len(cameras) - 1)
    shared = replace(dataset, cameras=tuple(cameras), intrinsics_sources=tuple(sources))
    return with_frames(shared, frames) if len(cameras) > len(dataset.cameras) else dataset


def refuse_other_units(camera: Camera, where: str) -> None:
    """Raises InputError ``intrinsics_invalid`` for a lens wider than possible, as wrong units make it."""
    full, w, h = camera.full(), camera.width, camera.height
    hint = (
        "Give the focal length and the principal point in pixels: shares of the photo are multiplied by its width "
        "and height, millimetres divided by the sensor's width and multiplied by the photo's."
    )
    in_corner = 0 <= full.cx <= 1 and 0 <= full.cy <= 1 and min(w, h) >= LEAST_SIDE
    view = _view_deg(full, w, h)
    if view > MOST_VIEW_DEG and not full.fisheye:
        share = in_corner or full.fx < LEAST_MM
        looks = "it looks like a share of the photo's width" if share else "it looks like millimetres"
        what = (
            f"a focal length of {full.fx:.4g} px on a photo of {w} x {h} px is an angle of view of {view:.0f} degrees: "
            f"{looks}."
        )
        raise InputError("intrinsics_invalid", what, where=where, hint=hint)
    if in_corner:
        what = (
            f"the principal point ({full.cx:g}, {full.cy:g}) lies in the corner of a photo of {w} x {h} px: it looks "
            "like shares of the photo's width and height."
        )
        raise InputError("intrinsics_invalid", what, where=where, hint=hint)


def lens_doubts(camera: Camera, header: ImageHeader) -> tuple[str, ...]:
    """Notes on a given lens of a photo that is most unusual, or that its EXIF contradicts."""
    full, side = camera.full(), max(camera.width, camera.height)
    least, most = PLAUSIBLE
    doubts = []
    if not full.fisheye and not least * side <= full.fx <= most * side:
        view = _view_deg(full, camera.width, camera.height)
        doubts.append(
            f"the focal length of {full.fx:.4g} px is an angle of view of {view:.3g} degrees, which few lenses "
            "have: it must be in pixels, of photos of this size"
        )
    exif = exif_focal_px(header)
    if exif is not None and not 1 / CONTRADICTS < full.fx / exif < CONTRADICTS:
        doubts.append(
            f"the focal length is given as {full.fx:.4g} px, and EXIF says {exif:.4g} px: it may be of photos of "
            "another size, or in another unit"
        )
    return tuple(doubts)


def _view_deg(full: FullParameters, width: int, height: int) -> float:
    """The angle of view (degrees) across the photo's width or height, whichever is larger, without distortion."""
    return 2 * math.degrees(math.atan(max(0.5 * width / full.fx, 0.5 * height / full.fy)))


def exif_focal_px(header: ImageHeader) -> float | None:
    """Focal length in pixels of the stored picture by its EXIF; None where it is absent or impossible.

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
