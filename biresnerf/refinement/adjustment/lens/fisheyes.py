"""Corrections of fisheyes: of their own parameters, as no pinhole can stand for them."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import torch
from numpy.typing import NDArray

from biresnerf.arrays import Array
from biresnerf.geometry.camera.camera import ABOVE, TANGENTIAL, Intrinsics, directions_in_cam, plane_position
from biresnerf.geometry.camera.camera_models import FullParameters
from biresnerf.refinement.adjustment.lens.lenses import ASPECT, FOCAL, K1, K2, LENS


def corrected_fisheye(lens: FullParameters, correction: Array) -> FullParameters:
    """A fisheye after a correction [8]: f e^l, fy e^(l + a), the principal point moved, and sums of coefficients."""
    longer, taller = float(np.exp(correction[FOCAL])), float(np.exp(correction[ASPECT]))
    k1, k2, right, down, p1, p2 = correction[K1:ASPECT].tolist()
    return lens._replace(
        fx=lens.fx * longer, fy=lens.fy * longer * taller, cx=lens.cx + lens.fx * right, cy=lens.cy + lens.fy * down,
        k1=lens.k1 + k1, k2=lens.k2 + k2, p1=lens.p1 + p1, p2=lens.p2 + p2,
    )  # fmt: skip


def with_corrections(intrinsics: Intrinsics, lens_of: NDArray[np.int64], corrections: Array) -> Intrinsics:
    """The same with corrections [g, 8] of fisheyes, whose rows are `lens_of` [n]; other lenses as they are."""
    if not len(corrections) or not corrections[lens_of[intrinsics.fisheye.numpy()]].any():
        return intrinsics
    i, c = intrinsics, torch.from_numpy(corrections[lens_of]) * intrinsics.fisheye[:, None]
    longer, taller = c[:, FOCAL].exp(), c[:, ASPECT].exp()
    distortion = i.distortion.clone()
    distortion[:, ABOVE][:, :2] += c[:, [K1, K2]]
    distortion[:, TANGENTIAL][:, :2] += c[:, [5, 6]]
    above, below, across = i.terms
    return replace(
        i, fx=i.fx * longer, fy=i.fy * longer * taller, cx=i.cx + i.fx * c[:, 3], cy=i.cy + i.fy * c[:, 4],
        distortion=distortion, terms=(max(above, 2), below, max(across, 2)),
    )  # fmt: skip


def moved_by_lens(now: Intrinsics, before: Intrinsics, image: NDArray[np.int64], xy: Array) -> Array:
    """How far [m, 2, 8] the correction's unknowns move, in px, what fisheyes show at `xy` [m, 2]."""
    index = torch.from_numpy(image)
    rays = directions_in_cam(now, index, torch.from_numpy(xy))
    x, y = (each.numpy() for each in plane_position(now, index, rays))
    fx, fy = now.fx[index].numpy(), now.fy[index].numpy()
    right, down = xy[:, 0] - now.cx[index].numpy(), xy[:, 1] - now.cy[index].numpy()
    s, none = x * x + y * y, np.zeros(len(xy))
    moved = np.empty((len(xy), 2, LENS))
    columns = (
        (right, down),
        (fx * x * s, fy * y * s),
        (fx * x * s * s, fy * y * s * s),
        (before.fx[index].numpy(), none),
        (none, before.fy[index].numpy()),
        (fx * 2 * x * y, fy * (s + 2 * y * y)),
        (fx * (s + 2 * x * x), fy * 2 * x * y),
        (none, down),
    )
    for kind, column in enumerate(columns):
        moved[:, :, kind] = np.stack(column, 1)
    return moved
