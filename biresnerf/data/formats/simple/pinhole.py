"""Undistorted photos with a PINHOLE model, for programs that know no other lens (3DGS, OpenMVS).

Every camera of it has square pixels and its principal point in the picture's middle, as 3DGS takes for granted (it
reads two angles of view and no more). Undistortion is our own: COLMAP's keeps the principal point where it was, so
that 3DGS would shift each picture; ours goes by the exact rays that poses were refined with, and needs no COLMAP.
"""

from __future__ import annotations

import os
import shutil
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from pathlib import Path, PurePosixPath

import numpy as np
from numpy.typing import NDArray
from PIL import Image

from biresnerf.data.formats.codec import Codec, cannot_hold
from biresnerf.data.formats.colmap.write_binary import write_colmap_binary
from biresnerf.data.formats.simple.bundler import write_bundler
from biresnerf.data.formats.simple.nerfstudio import NERFSTUDIO, write_nerfstudio
from biresnerf.data.formats.transforms.instant_ngp import INSTANT_NGP, write_transforms_ngp
from biresnerf.data.model.atomic_file import whole_file, write_json
from biresnerf.data.model.colmap_scene import ColmapImage
from biresnerf.data.model.dataset import Frame
from biresnerf.data.model.refined_set import RefinedImage, RefinedSet
from biresnerf.data.photos.bilinear import resampled
from biresnerf.data.photos.decode import decode
from biresnerf.data.photos.image_files import quiet_pillow
from biresnerf.data.show.renders import picture_stems
from biresnerf.errors import InputError, Interrupted
from biresnerf.geometry.camera.camera_models import Camera
from biresnerf.geometry.camera.pixel_rays import pixels_of_points, rays_of_pixels
from biresnerf.options.formats import Format

PINHOLE = Format(
    name="pinhole",
    title="undistorted photos with a PINHOLE model",
    rank=15,
    in_set="pinhole",
    needs=("photos",),
    loses=("rigs", "masks"),
    splats=True,
    heading="For 3D Gaussian splatting, gsplat, OpenMVS",
    hint="Photos without distortion, with PINHOLE cameras and points, for all programs that do not know the lens",
    downloads="pinhole/",
)

WIDEST_TANGENT = 1.75  # 60 degrees from the axis: beyond it a flat picture is all stretch
_JPEG = {"quality": 95, "subsampling": 0}
_THREADS = 4


def pinhole_camera(camera: Camera) -> Camera:
    """The largest centred pinhole picture that ``camera`` sees all of, as sharp as it in its middle.

    A camera that is one already comes back as it is.

    Raises:
        InputError: ``export_not_possible``: nothing is seen around the optical axis.
    """
    lens = camera.full()
    centred = lens.cx == camera.width / 2 and lens.cy == camera.height / 2
    if lens.fx == lens.fy and centred and not (lens.distorted or lens.fisheye or camera.shear):
        return Camera("PINHOLE", camera.width, camera.height, (lens.fx, lens.fy, lens.cx, lens.cy))
    width, height = camera.width, camera.height
    down, across = np.linspace(0, height, height + 1), np.linspace(0, width, width + 1)
    sides = [np.stack([x - camera.shear * (down - height / 2), down], 1) for x in (0, width)]
    caps = [np.stack([across, np.full_like(across, y)], 1) for y in (0, height)]
    focal = (lens.fx * lens.fy) ** 0.5
    seen = (
        min(
            _tangents(rays_of_pixels(lens, side), axis, sign).min()
            for side, sign in zip(edges, (-1, 1), strict=True)
        )
        for axis, edges in ((0, sides), (1, caps))
    )
    new_width, new_height = (int(2 * focal * min(tangent, WIDEST_TANGENT)) for tangent in seen)
    if new_width < 2 or new_height < 2:
        raise cannot_hold(
            PINHOLE.name,
            "a lens of this set sees nothing around its optical axis.",
            "Check the principal point.",
        )
    return Camera("PINHOLE", new_width, new_height, (focal, focal, new_width / 2, new_height / 2))


def _tangents(rays: NDArray[np.float64], axis: int, sign: int) -> NDArray[np.float64]:
    """How far out rays [m, 3] go on one side of the axis, as tangents; infinite to the side and behind."""
    ahead = rays[:, 2] > 1e-6
    return np.where(ahead, sign * rays[:, axis] / np.where(ahead, rays[:, 2], 1.0), np.inf)


def write_pinhole(refined: RefinedSet, folder: Path, should_stop: Callable[[], bool] = lambda: False) -> None:
    """Writes images/, a file for each program that needs such photos, and names.json (new name: input's name).

    Photos keep their names without folders, where those differ; JPEG stays JPEG, all else becomes PNG. EXIF data are
    not carried over.

    Raises:
        InputError: ``export_not_possible``, or a code of `decode` for a photo that cannot be read.
        Interrupted: ``should_stop`` returned true before a photo; a folder that was new is removed again.
    """
    new = not folder.exists()
    names = _names(refined)
    cameras = tuple(pinhole_camera(camera) for camera in refined.cameras)

    def convert(index: int) -> None:
        if should_stop():
            raise Interrupted("stopped while photos were written; run again to go on")
        _write_photo(refined.images[index], refined.camera_of(index), cameras[refined.images[index].camera],
                     folder / "images" / names[index])  # fmt: skip

    try:
        with quiet_pillow(), ThreadPoolExecutor(min(_THREADS, os.cpu_count() or 1)) as pool:
            list(pool.map(convert, range(len(refined))))
    except Interrupted:
        if new:
            shutil.rmtree(folder, ignore_errors=True)
        raise
    undistorted_set = _as_pinhole(refined, cameras, names)
    write_colmap_binary(undistorted_set.model, folder / "sparse" / "0")
    write_bundler(undistorted_set, folder)
    write_nerfstudio(undistorted_set, folder / NERFSTUDIO.in_set)
    write_transforms_ngp(undistorted_set, folder / INSTANT_NGP.in_set)
    named = dict(zip(names, (image.name for image in refined.images), strict=True))
    write_json(folder / "names.json", named, indent=1)


def _names(refined: RefinedSet) -> list[str]:
    """Plain file names: 3DGS uses the last part of a name, and only what is before its first dot identifies a view."""
    paths = [PurePosixPath(image.file_name) for image in refined.images]
    labels = {path.name.split(".")[0].casefold() for path in paths}
    stems = [path.stem for path in paths]
    if len(labels) < len(paths):
        stems = [
            stem.replace(".", "_") for stem in picture_stems([image.file_name for image in refined.images])
        ]
    suffixes = [path.suffix if path.suffix.lower() in (".jpg", ".jpeg", ".png") else ".png" for path in paths]
    return [stem + suffix for stem, suffix in zip(stems, suffixes, strict=True)]


def _as_pinhole(refined: RefinedSet, cameras: tuple[Camera, ...], names: list[str]) -> RefinedSet:
    """The same set as the new cameras see it: features go where their rays meet the new picture."""
    model = refined.model
    index_of = {number: row for row, number in enumerate(refined.image_ids)}
    lenses = dict(model.cameras)
    images: dict[int, ColmapImage] = {}
    for number, row in sorted(index_of.items()):
        image, old, new = model.images[number], refined.camera_of(row), cameras[refined.images[row].camera]
        lenses[image.camera_id] = new
        rays = rays_of_pixels(old.full(), image.points2d_px)
        images[number] = replace(image, name=names[row], points2d_px=pixels_of_points(new.full(), rays))
    used = {image.camera_id for image in images.values()}
    model = replace(
        model, cameras={k: v for k, v in lenses.items() if k in used}, images=images, rigs={}, frames={}
    )
    listed = tuple(
        replace(image, file_name=f"images/{name}") for image, name in zip(refined.images, names, strict=True)
    )
    return replace(refined, cameras=cameras, images=listed, model=model)


def _write_photo(image: RefinedImage, old: Camera, new: Camera, path: Path) -> None:
    if image.path is None:
        raise InputError(
            "image_missing",
            "is not known by its file.",
            where=image.name,
            hint="Name the folder of the photos (--photos).",
        )
    same = (new.width, new.height, new.full()) == (old.width, old.height, old.full())
    if same and image.orientation == 1 and not old.shear and image.path.suffix == path.suffix:
        with whole_file(path) as temporary:
            shutil.copyfile(image.path, temporary)
        return
    frame = Frame(image.name, image.path, 0, None, None, orientation=image.orientation, levels=image.levels)
    picture = decode(frame, old)
    flat = picture if same else undistorted(picture, old, new)
    with whole_file(path) as temporary:
        saved = Image.fromarray(flat)
        if path.suffix.lower() == ".png":
            saved.save(temporary, format="PNG", compress_level=3)
        else:
            saved.convert("RGB").save(temporary, format="JPEG", **_JPEG)


def undistorted(picture: NDArray[np.uint8], old: Camera, new: Camera) -> NDArray[np.uint8]:
    """The picture [h, w, channels] that ``old`` took, as the pinhole camera ``new`` at its place would; bilinear."""
    lens, focal, cx, cy = old.full(), new.params[0], new.params[2], new.params[3]

    def source_of(at: NDArray[np.float64]) -> NDArray[np.float64]:
        rays = np.column_stack([(at - [cx, cy]) / focal, np.ones(len(at))])
        return pixels_of_points(lens, rays)

    return resampled(picture, new.width, new.height, source_of)


CODECS = (
    Codec(PINHOLE, write=lambda refined, path, context: write_pinhole(refined, path, context.should_stop)),
)
