"""The caller's own form back, where it is none of those that every result has."""

from __future__ import annotations

from pathlib import Path

from biresnerf.data.formats.simple.llff import POSES_BOUNDS, given_bounds, write_poses_bounds
from biresnerf.data.model.dataset import Dataset
from biresnerf.data.model.refined_set import RefinedSet
from biresnerf.options.refine_options import PackName


def forms_of_input(dataset: Dataset) -> tuple[PackName, ...]:
    """The packs that a result has because its input was one of them."""
    source = dataset.source
    if source.dialect == "kitti":
        return ("kitti",)
    if source.dialect == "bundler":
        return ("bundler",)
    return ("colmap-text",) if source.colmap is not None and source.colmap.form == "text" else ()


def write_input_form(dataset: Dataset, refined: RefinedSet, folder: Path) -> None:
    """Writes the file of the input's own form into ``folder``, where no pack is that form.

    LLFF's rows, their order and their bounds of depth are those of the input's file.

    Raises:
        ValueError: that file has not a row for each image.
    """
    if dataset.source.dialect != "llff":
        return
    bounds = given_bounds(dataset.source.files[0], len(refined))
    write_poses_bounds(refined, list(range(len(refined))), bounds, folder / POSES_BOUNDS)
