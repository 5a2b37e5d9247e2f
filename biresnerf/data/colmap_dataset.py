"""A COLMAP model and the images it was made of, as a dataset."""

from __future__ import annotations

from collections import Counter
from pathlib import Path

import numpy as np

from biresnerf.data.colmap_reader import ColmapModel, read_colmap_model, world_from_cam_of
from biresnerf.data.dataset import Camera, Dataset, SourceFormat
from biresnerf.data.folder import IMAGE_FOLDER, images_below, images_in
from biresnerf.data.given_images import GivenImage, dataset_of, match_files
from biresnerf.data.image_files import read_header
from biresnerf.data.named_images import few_names
from biresnerf.data.orientation import same_shape
from biresnerf.errors import InputError


def read_colmap_dataset(root: Path, model_folder: Path, within: Path | None = None) -> Dataset:
    """The images of a model, by name, and those beside them that the model has not registered, without pose.

    Images lie in ``root``/images, or in ``root`` itself.

    Raises:
        InputError: codes as in docs/input.md.
    """
    model = read_colmap_model(model_folder)
    files = image_files(root)
    prefix = f"{IMAGE_FOLDER}/"
    if all(image.name.startswith(prefix) for image in model.images.values()):
        files = {(name if name.startswith(prefix) else prefix + name): path for name, path in files.items()}
    registered = sorted(model.images.values(), key=lambda image: image.name)
    table = "images.bin" if model.form == "binary" else "images.txt"
    found, notes = match_files(
        [image.name for image in registered], list(files), lambda i: f"{table} image {registered[i].id}"
    )
    given = [
        GivenImage(
            image.name,
            files[file],
            model.cameras[image.camera_id],
            world_from_cam_of(image.cam_from_world),
            f"{table} image {image.id}",
        )
        for image, file in zip(registered, found, strict=True)
    ]
    for file in sorted(files.keys() - set(found)):
        camera = _likely_camera(model, files[file], file)
        given.append(GivenImage(file, files[file], camera, None, file))
    tables = tuple(sorted(path for path in model_folder.iterdir() if path.suffix == Path(table).suffix))
    source = SourceFormat("colmap", None, {}, np.eye(4), colmap=model, files=tables)
    ordered = sorted(given, key=lambda image: image.name)
    return dataset_of(root, ordered, source, [*model.notes, *notes, *_beside_notes(model_folder)], within)


def image_files(root: Path) -> dict[str, Path]:
    """The images in ``root``/images, else in ``root``, by their path there, with forward slashes.

    Raises:
        InputError: ``no_images``.
    """
    files = images_beside(root)
    if not files:
        raise InputError(
            "no_images",
            "there are poses, but no images.",
            where=str(root),
            mend="Put the images into images/ beside the poses.",
        )
    return files


def images_beside(root: Path) -> dict[str, Path]:
    """As `image_files`; empty where there are none."""
    folder = root / IMAGE_FOLDER
    paths = images_below(folder)
    if not paths:
        folder, paths = root, images_in(root)
    return {path.relative_to(folder).as_posix(): path for path in paths}


def _likely_camera(model: ColmapModel, path: Path, name: str) -> Camera | None:
    """Of an image that the model has not: the camera that took most of those of its shape; None where none did."""
    header = read_header(path, name)
    uses = Counter(image.camera_id for image in model.images.values())
    for number, _ in uses.most_common():
        camera = model.cameras[number]
        if same_shape(camera.width, camera.height, header.width, header.height):
            return camera
    return None


def _beside_notes(model_folder: Path) -> list[str]:
    """A note on further models: COLMAP writes sparse/1, sparse/2 where not all images hold together."""
    if model_folder.name != "0":
        return []
    others = sorted(
        path.name for path in model_folder.parent.iterdir() if path.name.isdecimal() and path.name != "0"
    )
    if not others:
        return []
    return [
        f"the model {model_folder.parent.name}/0 was read and the models {few_names(others)} beside it were not"
    ]
