"""Which cameras of a set must not move, and which are one rigid body."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from biresnerf.data.model.dataset import Dataset
from biresnerf.errors import InputError
from biresnerf.geometry.rigid_bodies import RigidBodies
from biresnerf.options.refine_options import ResolvedOptions


def rigid_bodies(dataset: Dataset, options: ResolvedOptions) -> RigidBodies:
    """The bodies of a set: one for each moment of a COLMAP rig with several cameras, one for every other image.

    ``options.fixed`` names images as the input writes them or by their path relative to its folder.

    Raises:
        InputError: ``fixed_not_found`` or ``fixed_without_pose``.
    """
    rows = _fixed_rows(dataset, options.fixed)
    of = np.arange(len(dataset))
    for group in _moments(dataset):
        of[group] = group[0]
    _, of = np.unique(of, return_inverse=True)
    held = np.zeros(len(dataset), dtype=np.bool_)
    held[np.isin(of, of[rows])] = True
    return RigidBodies(of.astype(np.int64), held)


def _fixed_rows(dataset: Dataset, fixed: Sequence[str]) -> list[int]:
    rows_of = {name: dataset.called(name) for name in fixed}
    missing = [name for name in fixed if not rows_of[name]]
    if missing:
        raise InputError(
            "fixed_not_found",
            f"there is no image {missing[0]!r}.",
            where="fixed",
            hint="Name images as the input does, or by their path relative to its folder.",
        )
    for name, rows in rows_of.items():
        if dataset.frames[rows[0]].pose_source != "given":
            raise InputError(
                "fixed_without_pose",
                f"{name!r} is to stay fixed, but the input has no pose for it.",
                where="fixed",
                hint="Give its pose, or leave it out of fixed.",
            )
    return [row for rows in rows_of.values() for row in rows]


def _moments(dataset: Dataset) -> list[list[int]]:
    """Groups of several images, as rows, that one frame of a COLMAP rig took or that were cut from one panorama."""
    if dataset.cut is not None:
        groups = (np.flatnonzero(dataset.cut.rows == row).tolist() for row in range(len(dataset.cut.whole)))
        return [group for group in groups if len(group) > 1]
    model = dataset.source.colmap
    if model is None:
        return []
    row_of = {frame.name: i for i, frame in enumerate(dataset.frames) if frame.pose_source == "given"}
    moments = []
    for moment in model.frames.values():
        names = [model.images[image].name for sensor, image in moment.data_ids if sensor[0] == "CAMERA"]
        rows = sorted(row_of[name] for name in names if name in row_of)
        if len(rows) > 1:
            moments.append(rows)
    return moments
