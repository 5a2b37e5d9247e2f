"""A set in other forms at the poses it has: each where programs look for it in a folder, with the photos beside."""

from __future__ import annotations

import json
import os
import shutil
import tempfile
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Literal, TypeAlias

import numpy as np

from biresnerf.data.formats.colmap.write_binary import write_colmap_binary
from biresnerf.data.formats.colmap.write_text import write_colmap_text
from biresnerf.data.formats.simple.bundler import write_bundler
from biresnerf.data.formats.simple.llff import POSES_BOUNDS, given_bounds, write_llff
from biresnerf.data.formats.simple.pinhole import PINHOLE, write_pinhole
from biresnerf.data.formats.simple.poses_json import POSES, write_poses_json
from biresnerf.data.formats.simple.scene_glb import SCENE, write_scene
from biresnerf.data.formats.simple.trajectory import write_kitti, write_tum
from biresnerf.data.formats.transforms.instant_ngp import TRANSFORMS_NGP, write_transforms_ngp
from biresnerf.data.formats.transforms.write_intrinsics import lens_values
from biresnerf.data.formats.transforms.write_transforms import transforms_notes, write_transforms
from biresnerf.data.model.atomic_file import whole_file
from biresnerf.data.model.dataset import Dataset
from biresnerf.data.model.refined_set import RefinedSet, refined_set
from biresnerf.data.photos.mask_files import mask_beside
from biresnerf.data.points.refined_points import with_given_points
from biresnerf.errors import InputError

FormName = Literal[
    "transforms", "colmap", "colmap-text", "instant-ngp", "tum", "kitti", "bundler", "llff", "pinhole", "poses", "scene"
]  # fmt: skip
Photos = Literal["link", "copy", "none"]
CAMERA = "camera.json"
Writer: TypeAlias = Callable[[Dataset, RefinedSet, Path], Path]  # set, poses, folder -> the place in it


@dataclass(frozen=True)
class Written:
    """What a conversion did: the file or folder of each form, and what is to be known of it."""

    places: dict[FormName, Path]
    left_out: tuple[str, ...]
    notes: tuple[str, ...]


def convert(
    dataset: Dataset,
    forms: Sequence[FormName],
    folder: Path,
    photos: Photos = "link",
    bounds: tuple[float, float] | None = None,
) -> Written:
    """Writes the set into ``folder`` (new, or empty) in each of the forms; nothing is optimised.

    Images without a pose are left out.

    Args:
        photos: whether images and masks are linked or copied there, under the names that they have in the set's folder.
        bounds: nearest and farthest depth, for LLFF's form; where left out, of the points that each image sees.

    Raises:
        InputError: ``no_poses``, ``pack_not_possible``: a form cannot hold this set; ``bounds_missing``.
    """
    posed = [frame for frame in dataset.frames if frame.world_from_cam is not None]
    left_out = tuple(frame.name for frame in dataset.frames if frame.world_from_cam is None)
    if not posed:
        raise InputError(
            "no_poses",
            "holds no poses to convert.",
            where=str(dataset.root),
            hint="Find them with `biresnerf refine`.",
        )
    chosen = replace(dataset, frames=tuple(posed))
    refined = refined_set(chosen, chosen.world_from_cam)
    if dataset.source.colmap is not None:
        refined = with_given_points(refined, dataset.source.colmap)
    with _whole_folder(folder) as staging:
        writers = {**_WRITERS, "llff": _llff_writer(bounds)}
        places = {form: writers[form](chosen, refined, staging).relative_to(staging) for form in forms}
        if photos != "none":
            _bring_photos(chosen, staging, photos)
    return Written({form: folder / place for form, place in places.items()}, left_out, _notes(chosen, forms))


@contextmanager
def _whole_folder(folder: Path) -> Iterator[Path]:
    """A folder to write to, which takes the place of ``folder`` (new, or empty) at the end; gone after a failure."""
    folder.parent.mkdir(parents=True, exist_ok=True)
    staging = Path(tempfile.mkdtemp(prefix=f".{folder.name}.", dir=folder.parent))
    try:
        yield staging
        staging.chmod(0o755)
        os.replace(staging, folder)
    except BaseException:
        shutil.rmtree(staging, ignore_errors=True)
        raise


def _notes(dataset: Dataset, forms: Sequence[FormName]) -> tuple[str, ...]:
    notes = transforms_notes(dataset, dataset.world_from_cam) if "transforms" in forms else ()
    bare = [form for form in forms if form in ("tum", "kitti")]
    if bare and len(dataset.cameras) > 1:
        notes += (f"{' and '.join(bare)} know no lenses, and {CAMERA} can only hold one: none was written.",)
    return notes + _mask_notes(dataset, forms)


def _mask_notes(dataset: Dataset, forms: Sequence[FormName]) -> tuple[str, ...]:
    """Only transforms.json names masks; the other forms have those that lie where they are looked for."""
    masked = [frame for frame in dataset.frames if frame.mask is not None]
    unnamed = [form for form in forms if form not in ("transforms", "pinhole", "poses", "scene")]
    notes = []
    if masked and "pinhole" in forms:
        notes.append("pinhole has no masks: they do not fit its undistorted photos.")
    lost = sum(mask_beside(dataset.root, frame.path, frame.name)[0] != frame.mask for frame in masked)
    if lost and unnamed:
        forms_said = f"{', '.join(unnamed)} {'name' if len(unnamed) > 1 else 'names'}"
        notes.append(
            f"{forms_said} no masks: {lost} of them are not where they are looked for, masks/NAME.png."
        )
    return tuple(notes)


def _bring_photos(dataset: Dataset, folder: Path, how: Literal["link", "copy"]) -> None:
    files = {frame.path for frame in dataset.frames}
    files |= {frame.mask for frame in dataset.frames if frame.mask is not None}
    for file in sorted(files):
        name = Path(os.path.relpath(file, dataset.root))
        if ".." in name.parts:
            raise InputError(
                "image_outside",
                "lies outside of the set's folder, and cannot be brought along.",
                where=str(file),
                hint="Leave photos where they are: --photos none.",
            )
        target = folder / name
        target.parent.mkdir(parents=True, exist_ok=True)
        if how == "link":
            target.symlink_to(file.resolve())
        else:
            shutil.copyfile(file, target)


def _trajectory(write: Callable[[RefinedSet, Path], None], name: str) -> Writer:
    """A trajectory, and the lens beside it where there is one for all images."""

    def written(dataset: Dataset, refined: RefinedSet, folder: Path) -> Path:
        write(refined, folder / name)
        if len(dataset.cameras) == 1:
            with whole_file(folder / CAMERA) as temporary:
                temporary.write_text(json.dumps(lens_values(dataset.cameras[0]), indent=2) + "\n", "utf-8")
        return folder / name

    return written


def _llff_writer(bounds: tuple[float, float] | None) -> Writer:
    """LLFF's form, with these bounds, or those of the input where it has that form, or of the points."""

    def written(dataset: Dataset, refined: RefinedSet, folder: Path) -> Path:
        depths = None if bounds is None else np.tile(bounds, (len(refined), 1))
        if depths is None and dataset.source.dialect == "llff":
            depths = given_bounds(dataset.source.files[0], len(refined))
        write_llff(refined, folder / POSES_BOUNDS, depths)
        return folder / POSES_BOUNDS

    return written


def _place(write: Callable[[Dataset, RefinedSet, Path], None], name: str) -> Writer:
    def written(dataset: Dataset, refined: RefinedSet, folder: Path) -> Path:
        write(dataset, refined, folder / name)
        return folder / name

    return written


_WRITERS: dict[FormName, Writer] = {
    "transforms": _place(lambda d, _, path: write_transforms(d, d.world_from_cam, path), "transforms.json"),
    "colmap": _place(lambda _, refined, path: write_colmap_binary(refined.model, path), "sparse/0"),
    "colmap-text": _place(lambda _, refined, path: write_colmap_text(refined.model, path), "sparse_txt/0"),
    "instant-ngp": _place(lambda _, refined, path: write_transforms_ngp(refined, path), TRANSFORMS_NGP),
    "tum": _trajectory(write_tum, "tum.txt"),
    "kitti": _trajectory(write_kitti, "kitti.txt"),
    "bundler": _place(lambda _, refined, path: write_bundler(refined, path.parent), "bundle.out"),
    "pinhole": _place(lambda _, refined, path: write_pinhole(refined, path, lambda: False), PINHOLE),
    "poses": _place(lambda _, refined, path: write_poses_json(refined, path), POSES),
    "scene": _place(lambda _, refined, path: write_scene(refined, path), SCENE),
}
