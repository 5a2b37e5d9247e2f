"""COLMAP models as formats: where a folder holds them, and which of the two file formats is written."""

from __future__ import annotations

import os
from pathlib import Path

from biresnerf.data.formats.codec import Codec
from biresnerf.data.formats.colmap.read_colmap import bind_colmap, parse_colmap
from biresnerf.data.formats.colmap.read_model import image_count, model_file_formats
from biresnerf.data.formats.colmap.write_binary import write_colmap_binary
from biresnerf.data.formats.colmap.write_text import write_colmap_text
from biresnerf.data.photos.photo_folders import IMAGE_FOLDER, images_in
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
