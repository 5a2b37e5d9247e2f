"""Patches as a term of the adjustment: photos compared with photos, through the depth of the field."""

from __future__ import annotations

from collections.abc import Callable
from typing import TypeVar

import numpy as np
from numpy.typing import NDArray

from biresnerf.arrays import Array
from biresnerf.geometry.camera.camera import Intrinsics
from biresnerf.refinement.adjustment.cameras import Cameras, lens_rows
from biresnerf.refinement.adjustment.evidence import Patches
from biresnerf.refinement.adjustment.kernels.patches import (
    UNSEEN,
    patch_errors,
    patch_system,
    settle_scales,
)
from biresnerf.refinement.adjustment.solver.blocks import Blocks
from biresnerf.refinement.adjustment.solver.in_parts import in_parts
from biresnerf.refinement.adjustment.solver.term import Linearised
from biresnerf.refinement.numbers.finish import EvidenceNumbers

Seen = tuple[object, ...]  # what all kernels read
Result = TypeVar("Result")

LONGEST_SCALE_STEP = 0.02


class PatchTerm:
    """Colour differences of patches, in the noise expected of their pixels.

    Args:
        noise: what a comparison's error is to be divided by, beyond what is expected of its pixels: neighbouring
            pixels, and all comparisons of a patch, err alike.
        last_only: begin at the finest level.

    Attributes:
        unknowns: factor [p] of each patch's inverse depths.
        scale: errors of this size have lost three quarters of their weight.
    """

    def __init__(
        self,
        patches: Patches,
        intrinsics: Intrinsics,
        cameras: Cameras,
        numbers: EvidenceNumbers,
        noise: float = 1.0,
        *,
        last_only: bool = False,
    ) -> None:
        photos = patches.photos
        self.patches, self.noise, self._numbers = patches, noise, numbers
        self._levels = list(numbers.patch_levels[-1:] if last_only else numbers.patch_levels)
        self.start = np.searchsorted(patches.point, np.arange(len(patches) + 1)).astype(np.int64)
        self.lens = lens_rows(intrinsics, cameras)
        ratio = [photos.widths / intrinsics.width.numpy(), photos.heights / intrinsics.height.numpy()]
        self.lens[:, :4] *= np.stack(ratio * 2, 1)
        self.frames = np.stack([photos.offsets[:-1], photos.widths, photos.heights], 1).astype(np.int64)
        self.unknowns = np.ones(len(patches))
        self._expected = numbers.pixel_noise, numbers.pixel_shift
        self._tied: Blocks | None = None
        self._blur, self.scale = self._levels[0]
        self.blur(self._blur)

    def blur(self, sigma_px: float) -> None:
        """Compare photos that are blurred by so much."""
        photos, patches = self.patches.photos, self.patches
        smooth, self.coefficients = photos.smoothed(sigma_px)
        lens, host = self.lens[patches.host][:, None], patches.host[:, None]
        at = np.floor(patches.rays[..., :2] * lens[..., :2] + lens[..., 2:4]).astype(np.int64)
        self.values = smooth[photos.offsets[host] + at[..., 1] * photos.widths[host] + at[..., 0]].astype(
            np.float64
        )

    def measure(self, cameras: Cameras) -> float:
        """Go on to the next finer level; returns 0 where there is none, else 1."""
        if not self._levels:
            return 0.0
        blur, self.scale = self._levels.pop(0)
        if blur != self._blur:
            self._blur = blur
            self.blur(blur)
        return 1.0

    def squares(self, cameras: Cameras, scales: Array) -> Array:
        """Mean square [m] of each comparison."""
        squared = np.empty(len(self.patches.target))
        self._in_parts(lambda part: patch_errors(*part[1], *self._expected, squared), cameras, scales)
        return squared

    def settle(self, cameras: Cameras) -> None:
        """Set the depths' scales to those that fit best, with cameras fixed."""
        deviation = self._numbers.scale_deviation
        fixed = *self._expected, self.scale, deviation, 2 * deviation
        self._in_parts(lambda part: settle_scales(*part[1], *fixed), cameras, self.unknowns)

    def inliers(self, cameras: Cameras) -> NDArray[np.bool_]:
        """Which comparisons [m] are within the robust scale."""
        return np.asarray(self.squares(cameras, self.unknowns) < self.scale**2)

    def cost(self, cameras: Cameras, unknowns: Array) -> float:
        square, most = self.squares(cameras, unknowns), self.scale**2
        robust = np.where(square < UNSEEN, most * square / (most + square), most)
        count = self.values.shape[1] * self.values.shape[2]
        away = (unknowns - 1) / self._numbers.scale_deviation
        return float(count * robust.sum() / self.noise**2 + (away**2).sum())

    def linearise(self, cameras: Cameras, damping: float) -> Linearised:
        images = self.patches.host, self.patches.target
        rows, parts = ([of(each) for each in images] for of in (cameras.rows, cameras.parts))
        deviation = self._numbers.scale_deviation
        fixed = *self._expected, self.scale, deviation, self.noise, damping
        of_target = np.zeros(rows[1].shape)
        if self._tied is None:
            together = np.insert(parts[1], self.start[:-1], parts[0], axis=0)
            self._tied = Blocks.tied(cameras, self.start + np.arange(len(self.start)), together)
        tied = self._tied

        def linearised(part: tuple[slice, Seen]) -> tuple[Blocks, Array, tuple[Array, ...]]:
            taken, seen = part
            system, right = tied.zero, np.zeros(cameras.unknowns)
            at = rows[0][taken], rows[1], parts[0][taken], parts[1], cameras.offsets
            return system, right, patch_system(*seen, *at, *fixed, system.arrays, right, of_target)

        found = self._in_parts(linearised, cameras, self.unknowns)
        back = [np.concatenate(each) for each in zip(*(one[2] for one in found), strict=True)]
        system, right = sum((one[0] for one in found), tied), np.sum([one[1] for one in found], axis=0)
        return Linearised(system, right, (*back, of_target, *rows))

    def stepped(self, linearised: Linearised, motion: Array) -> Array:
        inverses, gradients, of_host, of_target, host_rows, target_rows = linearised.back
        force = gradients + (of_host * motion[host_rows]).sum(1)
        targets = (of_target * motion[target_rows]).sum(1)
        force += np.bincount(self.patches.point, targets, len(self.patches))
        return np.asarray(self.unknowns + np.clip(-inverses * force, -LONGEST_SCALE_STEP, LONGEST_SCALE_STEP))

    def _in_parts(
        self, kernel: Callable[[tuple[slice, Seen]], Result], cameras: Cameras, scales: Array
    ) -> list[Result]:
        """Run a kernel on the patches, a part of them on each thread."""
        return in_parts(lambda part: kernel((part, self._seen(cameras, scales, part))), len(self.patches))

    def _seen(self, cameras: Cameras, scales: Array, taken: slice) -> Seen:
        patches = self.patches
        return (
            cameras.rotation, cameras.centre, cameras.lens_rows(self.lens), (self.coefficients, self.frames),
            self.values[taken], patches.host[taken], cameras.rays_of(patches.host[taken], patches.rays[taken]),
            patches.inverse_depth[taken], self.start[taken.start : taken.stop + 1], patches.target, scales[taken],
        )  # fmt: skip
