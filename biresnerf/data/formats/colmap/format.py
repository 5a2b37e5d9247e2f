"""COLMAP models as formats: where a folder holds them, and a model with the images it was made of as a dataset."""

from __future__ import annotations

import os
from collections import Counter
from dataclasses import replace
from pathlib import Path

import numpy as np

from biresnerf.data.formats.bind_images import by_name, dataset_of
from biresnerf.data.formats.codec import Codec
from biresnerf.data.formats.colmap.read_model import image_count, model_file_formats, read_colmap_model
from biresnerf.data.formats.colmap.write_binary import write_colmap_binary
from biresnerf.data.formats.colmap.write_text import write_colmap_text
from biresnerf.data.formats.match_names import match_files
from biresnerf.data.formats.parsed_poses import ParsedPoses, PoseEntry
from biresnerf.data.model.colmap_scene import ColmapModel
from biresnerf.data.model.dataset import Dataset, IntrinsicsSource, SourceFormat
from biresnerf.data.model.part_of_set import without_images
from biresnerf.data.photos.image_files import read_header
from biresnerf.data.photos.named_images import refuse_more_than_files
from biresnerf.data.photos.orientation import same_shape
from biresnerf.data.photos.photo_folders import (
    IMAGE_FOLDER,
    few_names,
    images_beside,
    images_in,
    photos_named,
    refuse_no_images,
    with_named,
)
from biresnerf.errors import InputError
from biresnerf.options.formats import Format

COLMAP = Format(
    name="colmap",
    title="COLMAP",
    rank=20,
    found_as=("sparse/0", "colmap/sparse/0", "sparse", "colmap/sparse", ".", "sparse_txt/0", "sparse_txt"),
    gives="poses, cameras, features, points, rigs, frames, all ids; binary or text, COLMAP 3.10 to 4.2",
    checked_against="pycolmap 4.2.1: every camera model, with rigs; models of 3.10.0 to 4.0.4; three real ones",
    cam_from_world=True,
    quaternion="wxyz",
    in_set="sparse/0",
    in_result="colmap/sparse/0",
    always=True,
    loses=("mask paths",),
    splats=True,
    heading="For COLMAP",
    hint="A binary model with the input's ids; gsplat and 3DGS read it too if the lenses have no distortion",
    downloads="colmap/sparse/",
)
COLMAP_TEXT = Format(
    name="colmap-text",
    title="COLMAP model as text",
    rank=21,
    in_set="sparse_txt/0",
    in_result="colmap/sparse_txt/0",
    loses=("mask paths",),
    splats=True,
    lacks="names with spaces",
    heading="For COLMAP, as text",
    hint="For programs that read no binary models",
    downloads="colmap/sparse_txt/",
)


def parse_colmap(_root: Path, model_folder: Path) -> ParsedPoses:
    """The registered images of a model, in the order of their names. Raises InputError as `read_colmap_model` does."""
    model = read_colmap_model(model_folder)
    table = _images_table(model)
    entries = tuple(
        PoseEntry(
            image.name,
            image.world_from_cam,
            f"{table} image {image.id}",
            model.cameras[image.camera_id],
            camera_id=image.camera_id,
        )
        for image in sorted(model.images.values(), key=lambda image: image.name)
    )
    tables = tuple(sorted(path for path in model_folder.iterdir() if path.suffix == Path(table).suffix))
    source = SourceFormat("colmap", colmap=model, files=tables)
    return ParsedPoses(source, entries, notes=(*model.notes, *_beside_notes(model_folder)))


def bind_colmap(parsed: ParsedPoses, root: Path, within: Path | None = None) -> Dataset:
    """The images of a model, and the unregistered ones beside them, without pose.

    Images lie in ``root``/images, or in ``root`` itself and those of its folders that the model names; else in the
    folder that holds most of the model's names.
    """
    model = parsed.source.colmap
    assert model is not None, "parse_colmap gives it"
    if within is not None:
        refuse_more_than_files(_images_table(model), len(parsed.entries), within)
    files = images_beside(root)
    prefix = f"{IMAGE_FOLDER}/"
    if parsed.entries and all(entry.name.startswith(prefix) for entry in parsed.entries):
        files = {(name if name.startswith(prefix) else prefix + name): path for name, path in files.items()}
    # Without images/, the model's folders of images lie in the root itself.
    elsewhere = {entry.name: root / entry.name for entry in parsed.entries if entry.name not in files}
    files |= {name: path for name, path in elsewhere.items() if path.is_file()}
    names = [entry.name for entry in parsed.entries]
    files = with_named(files, root, names)
    if not match_files(names, list(files))[0]:
        files = photos_named(root, names)
    refuse_no_images(files, root)
    pairs, notes = by_name(parsed.entries, list(files), strict=parsed.strict)
    model = without_images(model, {entry.name for entry in parsed.entries} - {one.name for _, one in pairs})
    images = [(files[name], entry) for name, entry in pairs]
    for name in sorted(files.keys() - {name for name, _ in pairs}):
        number = _likely_camera(model, files[name], name)
        lens = None if number is None else model.cameras[number]
        images.append((files[name], PoseEntry(name, None, name, lens, camera_id=number)))
    images.sort(key=lambda image: image[1].name)
    dataset = dataset_of(root, images, parsed.source, [*parsed.notes, *notes], within, strict=parsed.strict)
    model = without_images(model, {entry.name for _, entry in images} - set(dataset.names))
    fitted = _for_these_images(model, dataset, _images_table(model))
    dataset = replace(dataset, source=replace(parsed.source, colmap=fitted))
    if not _is_prediction(model):
        return dataset
    note = (
        "each point of the model is seen by one photo, as VGGT and Depth Anything 3 write them: its lenses are taken "
        "for what a network predicted"
    )
    found = [dataset.source_of_intrinsics(camera) for camera in range(len(dataset.cameras))]
    sources: list[IntrinsicsSource] = ["predicted" if by == "given" else by for by in found]
    return replace(dataset, intrinsics_sources=tuple(sources), warnings=(*dataset.warnings, note))


def _is_prediction(model: ColmapModel) -> bool:
    """Whether its points are pixels of depth maps: no matches, and so no lenses, were adjusted to each other."""
    return len(model.points) > 0 and bool((np.diff(model.points.track_starts) == 1).all())


def _images_table(model: ColmapModel) -> str:
    return "images.bin" if model.file_format == "binary" else "images.txt"


def _for_these_images(model: ColmapModel, dataset: Dataset, table: str) -> ColmapModel:
    """The model, with cameras and features for the images' true size where the model's are for another."""
    by_name = {image.name: image for image in model.images.values()}
    cameras, images, scaled = dict(model.cameras), dict(model.images), set()
    for index, frame in enumerate(dataset.frames):
        image = by_name.get(frame.name)
        if image is None:
            continue
        given, fitted = model.cameras[image.camera_id], dataset.camera_of(index)
        if image.camera_id in scaled and cameras[image.camera_id] != fitted:
            raise InputError(
                "mixed_sizes",
                f"images of camera {image.camera_id} differ in size.",
                where=f"{table} image {image.id}",
                hint="Give images of one size, that of the camera.",
            )
        scaled.add(image.camera_id)
        cameras[image.camera_id] = fitted
        if fitted != given:
            ratio = (fitted.width / given.width, fitted.height / given.height)
            images[image.id] = replace(image, points2d_px=image.points2d_px * ratio)
    return replace(model, cameras=cameras, images=images)


def _likely_camera(model: ColmapModel, path: Path, name: str) -> int | None:
    """The camera of an unregistered image: the one that took most images of its shape; None where none did."""
    header = read_header(path, name)
    uses = Counter(image.camera_id for image in model.images.values())
    for number, _ in uses.most_common():
        camera = model.cameras[number]
        if same_shape(camera.width, camera.height, header.width, header.height):
            return number
    return None


def _beside_notes(model_folder: Path) -> list[str]:
    """A note on further models: COLMAP writes sparse/1, sparse/2 where not all images hold together."""
    if not model_folder.name.isdecimal():
        return []
    numbered = [path for path in model_folder.parent.iterdir() if path.name.isdecimal()]
    others = sorted(
        (path for path in numbered if path.name != model_folder.name), key=lambda path: int(path.name)
    )
    if not others:
        return []
    read, folder = f"{model_folder.parent.name}/{model_folder.name}", model_folder.parent.name
    listed = few_names(f"{folder}/{path.name} ({image_count(path)})" for path in others)
    return [f"the model {read} ({image_count(model_folder)} images) was read, and not {listed}"]


def _model_folder(file: Path) -> Path | None:
    tables = ("cameras", "images", "points3D", "rigs", "frames")
    return file.parent if file.suffix.lower() in (".bin", ".txt") and file.stem in tables else None


def _image_root(folder: Path) -> Path:
    """The folder with images/ that holds a model's folder in one of the usual places."""
    parts = Path(os.path.abspath(folder)).parts
    parts = (*parts[:-1], "0") if parts[-1].isdecimal() else parts  # sparse/1 lies where sparse/0 does
    tails = [Path(name).parts for name in COLMAP.found_as]
    roots = [folder] + [Path(*parts[: -len(tail)]) for tail in tails if tail and parts[-len(tail) :] == tail]
    with_images = (root for root in roots if (root / IMAGE_FOLDER).is_dir() or images_in(root))
    return next(with_images, roots[-1])


CODECS = (
    Codec(
        COLMAP,
        parse=parse_colmap,
        bind=bind_colmap,
        recognises=lambda place: bool(model_file_formats(place)),
        pose_place=_model_folder,
        image_root=_image_root,
        count=image_count,
        write=lambda refined, path, _: write_colmap_binary(refined.model, path),
    ),
    Codec(
        COLMAP_TEXT,
        write=lambda refined, path, _: write_colmap_text(refined.model, path),
        given_back=lambda dataset: (
            dataset.source.colmap is not None and dataset.source.colmap.file_format == "text"
        ),
    ),
)
