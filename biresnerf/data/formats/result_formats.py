"""The formats of a result: written with it, or later from what a finished result holds."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import replace
from pathlib import Path

from biresnerf.data.formats.codec import WriteContext, cannot_hold
from biresnerf.data.formats.colmap.format import COLMAP
from biresnerf.data.formats.colmap.read_model import read_colmap_model
from biresnerf.data.formats.registry import ALL_CODECS
from biresnerf.data.formats.simple.poses_json import (
    POSES,
    POSES_JSON,
    PoseImage,
    body_offset_of,
    matrix_of,
    read_poses_json,
)
from biresnerf.data.formats.transforms.write_transforms import TRANSFORMS
from biresnerf.data.formats.write_each import Writing, write_each
from biresnerf.data.model.dataset import Dataset
from biresnerf.data.model.refined_set import BODY, RefinedImage, RefinedSet, of_whole
from biresnerf.data.photos.panoramas.cut_panoramas import PANORAMA_VIEWS
from biresnerf.errors import InputError
from biresnerf.geometry.body_offset import BodyOffset
from biresnerf.geometry.camera.camera_models import MODEL_PARAMETERS
from biresnerf.geometry.similarity import Similarity
from biresnerf.options.formats import PosesOf, formats


def write_result_formats(
    refined: RefinedSet,
    folder: Path,
    exports: Iterable[str] = (),
    context: WriteContext | None = None,
) -> tuple[str, ...]:
    """Writes the formats of every result into ``folder``, the input's own format, and ``exports``.

    Without the input in ``context``, the formats that need it are left out. An export that cannot hold the set is
    written in the format that its declaration names `instead`.

    Returns:
        a sentence for each export, or own format, that cannot hold this set.

    Raises:
        Interrupted: `WriteContext.should_stop` returned true.
    """
    context = context or WriteContext()
    own = () if context.dataset is None else formats_given_back(context.dataset)
    refused = {}
    for one in formats().values():
        if one.always and (context.dataset is not None or "input" not in one.needs):
            try:
                _write(refined, folder, one.name, context)
            except InputError as error:
                refused[one.name] = error
    writing = write_each(refined, (*own, *exports), lambda name: _write(refined, folder, name, context))
    refused |= writing.refused
    notes = [f"{name} was not written: {error}" for name, error in refused.items()]
    return (*notes, *writing.notes)


def export_result(
    refined: RefinedSet,
    folder: Path,
    names: Iterable[str],
    context: WriteContext,
    poses_of: PosesOf = "camera",
) -> tuple[list[str], list[str]]:
    """Writes formats at their places in a result in ``folder``; the poses of the camera's body into its body/.

    The body's poses are also written in the formats that every result has.

    Returns:
        the formats written, and notes: what is not known of the offset, and what stands for what.

    Raises:
        InputError: ``export_not_possible``: a format cannot hold the set, or shows what cameras see where the body's
            poses are requested, or no offset is known; others are written.
    """
    names = list(dict.fromkeys(names))
    if poses_of == "camera":
        writing = write_each(refined, names, lambda name: _write(refined, folder, name, context))
    else:
        if seeing := [name for name in names if not formats()[name].holds_bodies]:
            raise _not_of_body(f"{', '.join(seeing)} would show what cameras see")
        writing = _write_bodies(refined, folder, names, context)
    writing.raise_first()
    return writing.written, writing.notes


def write_body_beside(
    refined: RefinedSet, folder: Path, exports: Iterable[str], context: WriteContext
) -> tuple[str, ...]:
    """The body's poses beside a result, also in the input's own format. Returns a note for all that is not written."""
    names = list(dict.fromkeys(exports))
    try:
        writing = _write_bodies(
            refined, folder, [name for name in names if formats()[name].holds_bodies], context
        )
    except InputError as error:
        return (f"poses_of=body: {BODY}/ was not written: {error.detail}",)
    notes = [f"{BODY}/{name} was not written: {error}" for name, error in writing.refused.items()]
    if seeing := [name for name in names if not formats()[name].holds_bodies]:
        notes.append(
            f"{', '.join(seeing)} hold the poses of the cameras alone, as they show what cameras see."
        )
    return (*notes, *writing.notes)


def _write_bodies(refined: RefinedSet, folder: Path, names: Iterable[str], context: WriteContext) -> Writing:
    offset, dataset = refined.body_offset, context.dataset
    if offset is None:
        raise _not_of_body("no offset between these cameras and a body that carries them was found")
    always = [one.name for one in formats().values() if one.always and one.name != POSES_JSON.name]
    own = () if dataset is None else formats_given_back(dataset)
    without = set() if dataset is not None else {TRANSFORMS.name}
    chosen = [name for name in (*always, *own) if formats()[name].holds_bodies and name not in without]
    target, bodies = folder / BODY, refined.of_body(offset)
    target.mkdir(parents=True, exist_ok=True)
    writing = write_each(bodies, (*chosen, *names), lambda name: _write(bodies, target, name, context))
    writing.notes[:0] = half_known(offset)
    return writing


def half_known(offset: BodyOffset) -> list[str]:
    """A sentence where the place of the camera on the body is not known along all directions."""
    missing = 3 - offset.known_along.shape[1]
    if not missing:
        return []
    along = "" if missing == 3 else f" along {missing} of 3 directions"
    return [
        f"{BODY}/: the given poses do not tell where the camera sits on the body{along}. That shift counts as zero: "
        "where the body turned, its positions may be off by it."
    ]


def _not_of_body(why: str) -> InputError:
    return cannot_hold(
        "poses_of=body",
        f"{why}.",
        "Poses of the body follow where poses.json has body_from_camera, in formats of poses alone, as kitti.",
    )


def _write(refined: RefinedSet, folder: Path, name: str, context: WriteContext) -> None:
    codec, dataset = ALL_CODECS[name], context.dataset
    if dataset is not None and (name == TRANSFORMS.name or codec.given_back(dataset)):
        # These are of the input's own images; the others show what was cut from its panoramas.
        whole = of_whole(dataset, refined.world_from_cam, refined.similarity)
        if whole is not None:
            context, refined = replace(context, dataset=whole[0]), whole[1]
    codec.write_set(refined, folder / codec.format.in_result, context)


def formats_given_back(dataset: Dataset) -> tuple[str, ...]:
    """The formats that a result has because its input was in them, beside those that every result has."""
    return tuple(name for name, codec in ALL_CODECS.items() if codec.given_back(dataset))


def read_result(folder: Path, photos: Path | None = None) -> RefinedSet:
    """The result in ``folder``, from its poses.json and its COLMAP model.

    Args:
        folder: what `refine` wrote.
        photos: the input's folder, which file names are relative to; only formats that hold photos need it.

    Raises:
        InputError: ``result_missing``, ``result_inconsistent``, ``image_missing``, or a code of the readers.
    """
    path = folder / POSES
    if not path.is_file():
        raise InputError(
            "result_missing",
            f"holds no {POSES}.",
            where=str(folder),
            hint="Name the output folder of a finished `biresnerf refine`.",
        )
    document = read_poses_json(path)
    model = read_colmap_model(folder / COLMAP.in_result)
    id_of_name = {image.name: image.id for image in model.images.values()}
    image_ids = []
    for image in document.images:
        number = id_of_name.get(image.file_name, id_of_name.get(image.name))
        if number is None or not 0 <= image.camera < len(document.cameras):
            raise _inconsistent(folder, image.name)
        image_ids.append(number)
    for camera in document.cameras:
        if len(camera.params) != len(MODEL_PARAMETERS.get(camera.model, ())):
            raise _inconsistent(folder, camera.model)
    return RefinedSet(
        document.cameras,
        tuple(_image(image, photos, folder) for image in document.images),
        model,
        tuple(image_ids),
        document.points_source,
        Similarity.of(document.input_from_optimised),
        document.timestamps_s,
        body_offset_of(document),
    )


def _image(image: PoseImage, photos: Path | None, result: Path) -> RefinedImage:
    path = None if photos is None else photos / image.file_name
    if path is not None and image.file_name.startswith(f"{PANORAMA_VIEWS}/"):
        path = result / image.file_name
    if path is not None and not path.is_file():
        raise InputError(
            "image_missing",
            f"{image.file_name} is not there.",
            where=str(photos),
            hint="Name the input's folder, which the file names of poses.json are relative to.",
        )
    before = image.world_from_cam_before
    return RefinedImage(
        image.name,
        image.file_name,
        image.camera,
        matrix_of(image.world_from_cam),
        None if before is None else matrix_of(before),
        image.pose_source,
        image.flags,
        path,
        image.orientation,
        image.uncertainty,
    )


def _inconsistent(folder: Path, what: str) -> InputError:
    return InputError(
        "result_inconsistent",
        f"{POSES} and the model in {COLMAP.in_result} do not fit each other: {what!r}.",
        where=str(folder),
        hint="Leave the files of a result together, as they were written.",
    )
