"""`biresnerf make-scene OUT`: images with wrong or missing poses, and the true poses."""

from __future__ import annotations

import shutil
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING

import click

from biresnerf.commands.answers import json_option, show
from biresnerf.commands.empty_folder import require_empty
from biresnerf.errors import InputError

if TYPE_CHECKING:
    from biresnerf.data.model.dataset import Dataset

KINDS = {
    "still-life": "cameras on a dome above wood, brick, marble and cloth in soft light; each pose is turned at random",
    "dome": "the same cameras above shapes with random textures",
    "phone": "a phone's walk around a table; poses drift, focal length 1 % too long",
    "half": "the same walk as a COLMAP model that lacks half of the images",
    "vase": "a plain vase without background; each pose is turned at random",
    "panoramas": "360° photos of a walk around the table; each pose is turned at random",
    "turntable": "the same vase turned once before the camera, in uneven steps; without poses, those of --of too",
}
_FOCAL_TOO_LONG = 1.01
CAMERAS = ("none", "iphone", "iphone-upright", "android", "reflex", "drone")
_CAMERA_OF_KIND = {"phone": "iphone", "half": "iphone"}


@dataclass(frozen=True)
class MadeScene:
    """The set that was written, how many of its images have a pose, and the file with the true poses."""

    folder: Path
    images: int
    with_pose: int
    truth: Path

    def __str__(self) -> str:
        posed = " without poses"
        if self.with_pose > 0:
            partial = f", of which the COLMAP model in sparse/0 has {self.with_pose}"
            posed = partial if self.with_pose < self.images else ""
        return f"{self.images} views in {self.folder}{posed}, true poses in {self.truth}"


@click.command("make-scene")
@click.argument("output", type=click.Path(path_type=Path))
@click.option(
    "--kind", type=click.Choice(list(KINDS)), default="still-life", show_default=True,
    help="; ".join(f"{kind}: {text}" for kind, text in KINDS.items()) + ".",
)  # fmt: skip
@click.option(
    "--of", "own", type=click.Path(path_type=Path),
    help="Use these images and poses, in any format that `refine` reads, as the truth instead of rendering some.",
)  # fmt: skip
@click.option("--views", type=click.IntRange(3, 400), default=60, show_default=True, help="Number of images.")
@click.option(
    "--size", type=click.IntRange(16, 2048), default=100, show_default=True, help="Their width, px."
)
@click.option(
    "--noise", type=click.FloatRange(0, 1), default=0.15, show_default=True,
    help="Standard deviation of the pose noise, as in BARF, for dome, still-life, vase and panoramas; for turntable, "
    "share by which its steps are uneven.",
)  # fmt: skip
@click.option(
    "--camera", type=click.Choice(CAMERAS),
    help="Who takes the photos that are rendered: JPEG files with all the EXIF of such a camera, turned if held "
    "upright; none: PNG without any. [default: iphone for phone and half, else none]",
)  # fmt: skip
@click.option(
    "--seed", type=click.IntRange(0, 2**31 - 1), default=0, show_default=True, help="Seed of scene and noise."
)
@json_option
def make_scene_command(
    output: Path, kind: str, own: Path | None, views: int, size: int, noise: float, camera: str | None, seed: int,
    as_json: bool,
) -> None:  # fmt: skip
    """Make a scene with wrong or missing poses, and a file with the true ones.

    The scene is written to OUTPUT, the true poses to OUTPUT.truth.json; `biresnerf evaluate` compares a result with it.
    """
    made = make_scene(output, kind, own=own, views=views, size=size, noise=noise, camera=camera, seed=seed)
    document = {**asdict(made), "folder": str(made.folder), "truth": str(made.truth)}
    show(document, str(made), as_json=as_json)


def make_scene(
    output: Path,
    kind: str = "still-life",
    *,
    own: Path | None = None,
    views: int = 60,
    size: int = 100,
    noise: float = 0.15,
    camera: str | None = None,
    seed: int = 0,
) -> MadeScene:
    """Writes a set of a kind of `KINDS` to `output`, and its true poses to OUTPUT.truth.json.

    Args:
        own: a set with poses, in any readable format, to perturb instead of rendering one.
        size: width (px) of rendered images.
        noise: standard deviation of the pose noise, as in BARF, for the kinds with random noise; for a turntable, the
            share by which its steps are uneven.
        camera: one of `CAMERAS`, for rendered images; None: the usual one for the kind.

    Raises:
        InputError: `output` is not empty, or `own` cannot be read or lacks poses.
    """
    require_empty(output)
    from biresnerf.data.formats.transforms.read_transforms import read_transforms

    camera = camera or _CAMERA_OF_KIND.get(kind, "none")
    path = _copied(own, output) if own else _made(output, kind, views, size, noise, camera, seed)
    truth = output.with_name(f"{output.name}.truth.json")
    shutil.copyfile(path, truth)
    dataset = read_transforms(path)
    if kind == "half":
        return MadeScene(output, len(dataset), _keep_half(dataset, path), truth)
    if kind == "turntable":
        _take_poses_away(path)
        return MadeScene(output, len(dataset), 0, truth)
    _perturb_file(dataset, path, kind, noise, seed)
    return MadeScene(output, len(dataset), len(dataset), truth)


def _made(output: Path, kind: str, views: int, size: int, noise: float, camera: str, seed: int) -> Path:
    """A rendered set with true poses; its transforms.json."""
    from biresnerf.data.synthetic.camera_photos import MAKERS
    from biresnerf.data.synthetic.captures import (
        write_panoramas,
        write_turntable,
        write_vase,
        write_walk,
    )
    from biresnerf.data.synthetic.scene import write_synthetic_scene

    if kind == "turntable":
        return write_turntable(output, views, size, seed, noise, MAKERS.get(camera))
    if kind == "panoramas":
        return write_panoramas(output, views, size, seed)
    if kind == "still-life":
        from biresnerf.data.synthetic.still_life import write_still_life

        return write_still_life(output, views, size, seed, MAKERS.get(camera))
    write = {"dome": write_synthetic_scene, "vase": write_vase}.get(kind, write_walk)
    return write(output, views, size, seed, MAKERS.get(camera))


def _copied(own: Path, output: Path) -> Path:
    """Copies the user's images to `output`, with their poses in a transforms.json of nerfstudio's dialect."""
    from biresnerf.data.formats.read_dataset import read_dataset
    from biresnerf.data.formats.transforms.write_transforms import write_transforms
    from biresnerf.data.model.dataset import SourceFormat

    dataset = read_dataset(own)
    if not dataset.posed.all():
        raise InputError(
            "poses_missing",
            f"{int((~dataset.posed).sum())} of {len(dataset)} images have no pose that could serve as the truth.",
            where=str(own),
            hint="Give a set with all poses, for example a result of `biresnerf refine`.",
        )
    frames = []
    for name, frame in zip(dataset.file_names, dataset.frames, strict=True):
        copy = output / "images" / name
        copy.parent.mkdir(parents=True, exist_ok=True)
        shutil.copyfile(frame.path, copy)
        frames.append(replace(frame, path=copy, raw={}))
    copied = replace(dataset, root=output, frames=tuple(frames), source=SourceFormat("nerfstudio"))
    path = output / "transforms.json"
    write_transforms(copied, copied.world_from_cam, path)
    return path


def _perturb_file(dataset: Dataset, path: Path, kind: str, noise: float, seed: int) -> None:
    """Writes wrong poses into the transforms file."""
    import json

    from biresnerf.data.formats.transforms.write_transforms import write_transforms
    from biresnerf.data.model.image_order import natural_order
    from biresnerf.data.photos.orientation import shown_from_cam
    from biresnerf.geometry.perturb import drift_like_a_phone, perturb_poses

    true = dataset.world_from_cam
    if kind != "phone":
        write_transforms(dataset, perturb_poses(true, noise, seed), path)
        return
    order = natural_order(dataset.file_names)
    # Gravity is where photos say it is, however the phone was held.
    shown = shown_from_cam(dataset.frames)[order]
    drifted = true.copy()
    drifted[order] = drift_like_a_phone(true[order] @ shown.swapaxes(1, 2), seed) @ shown
    write_transforms(dataset, drifted, path)
    document = json.loads(path.read_text("utf-8"))
    for part in (document, *document["frames"]):
        part.update({key: part[key] * _FOCAL_TOO_LONG for key in ("fl_x", "fl_y") if key in part})
    path.write_text(json.dumps(document, indent=1) + "\n", "utf-8")


def _take_poses_away(path: Path) -> None:
    """Removes the poses from a transforms file; the images and their lens stay."""
    import json

    document = json.loads(path.read_text("utf-8"))
    for frame in document["frames"]:
        del frame["transform_matrix"]
    path.write_text(json.dumps(document, indent=1) + "\n", "utf-8")


def _keep_half(dataset: Dataset, path: Path) -> int:
    """Replaces the transforms file by a COLMAP model of the first half of the images; returns their number."""
    from biresnerf.data.formats.colmap.write_binary import write_colmap_binary
    from biresnerf.data.model.image_order import natural_order
    from biresnerf.data.model.result_model import model_of_poses

    names = [name.removeprefix("images/") for name in dataset.file_names]
    kept = natural_order(names)[: (len(names) + 1) // 2]
    model = model_of_poses(
        [names[i] for i in kept],
        dataset.cameras,
        [dataset.frames[i].camera for i in kept],
        dataset.world_from_cam[kept],
    )
    write_colmap_binary(model, path.parent / "sparse" / "0")
    path.unlink()
    return len(kept)
