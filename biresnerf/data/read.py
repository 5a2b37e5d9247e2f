"""Any input a user may give, read and validated: the one door into `biresnerf.data`."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

from biresnerf.data.dataset import Dataset
from biresnerf.data.folder import look_into
from biresnerf.data.transforms_json import read_transforms
from biresnerf.errors import InputError


def read_dataset(
    path: Path,
    *,
    should_stop: Callable[[], bool] | None = None,
    seed: int = 0,
    seeding_limit_s: float = 3600.0,
    remember: Path | None = None,
    on_seeding: Callable[[], None] | None = None,
) -> Dataset:
    """Reads a transforms file, or a folder with one, or a folder of images whose poses COLMAP then finds.

    Everything is validated but the pixels, which `biresnerf.data.images.load_images` decodes.

    Args:
        path: a transforms.json (nerfstudio, instant-ngp or Blender dialect) or a folder.
        should_stop: asked while COLMAP runs.
        seed: of COLMAP's random choices.
        seeding_limit_s: seconds that COLMAP may take.
        remember: a file that keeps COLMAP's answer, so that a continued run is given the same poses again.
        on_seeding: called when COLMAP is about to run.

    Raises:
        InputError: the input cannot be used; says the file, the field and the mend.
        Interrupted: ``should_stop`` said so while COLMAP ran.
    """
    path = Path(path)
    if path.is_file():
        _refuse_other_files(path)
        return read_transforms(path)
    if not path.is_dir():
        raise InputError(
            "input_missing", "does not exist.", where=str(path), mend="Give a folder or a transforms.json."
        )
    contents = look_into(path)
    if contents.transforms is not None:
        dataset = read_transforms(contents.transforms)
        return replace(dataset, warnings=contents.notes + dataset.warnings)
    from biresnerf.data.seed_colmap import seed_poses

    return seed_poses(
        contents.root,
        contents.images,
        should_stop=should_stop,
        seed=seed,
        limit_s=seeding_limit_s,
        remember=remember,
        on_start=on_seeding,
    )


def _refuse_other_files(path: Path) -> None:
    if path.suffix.lower() != ".json":
        raise InputError(
            "input_unsupported",
            "is neither a folder nor a .json file.",
            where=path.name,
            mend="Give a transforms.json, or a folder that holds one or the images.",
        )
