"""Symmetric matrices over cameras and lenses: only blocks of those that evidence ties are stored."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from biresnerf.arrays import Array
from biresnerf.refinement.adjustment.cameras import POSE, Cameras
from biresnerf.refinement.adjustment.kernels.blocks import seen_together
from biresnerf.refinement.adjustment.lens.lenses import LENS


@dataclass(frozen=True, eq=False)
class Blocks:
    """A matrix of the unknowns [6n + 8g] of n cameras, or bodies, and g lenses: the parts, in this order.

    Attributes:
        cameras, lenses: n and g.
        begin: int64 [n + g + 1], where each part's blocks begin.
        other: int64 [b], of each block the part of its columns, ascending from its own: all have a diagonal block.
        values: [b, w, w], those on the diagonal whole; w is 6 without lenses, else 8, and zero beyond a camera's
            unknowns.
    """

    cameras: int
    lenses: int
    begin: NDArray[np.int64]
    other: NDArray[np.int64]
    values: Array

    @classmethod
    def tied(cls, cameras: Cameras, start: NDArray[np.int64], parts: NDArray[np.int64]) -> Blocks:
        """Zero, with a block for all parts that are seen together.

        Args:
            start: [c + 1], where what is seen together begins, and ends, in parts.
            parts: [m, k], those of each observation.
        """
        begin, other = tied_parts(len(cameras) + len(cameras.lens), start, parts)
        return cls(len(cameras), len(cameras.lens), begin, other, _room(len(other), len(cameras.lens)))

    @classmethod
    def nothing(cls, cameras: Cameras) -> Blocks:
        """Zero, with nothing tied."""
        count = len(cameras) + len(cameras.lens)
        values = _room(count, len(cameras.lens))
        return cls(len(cameras), len(cameras.lens), np.arange(count + 1), np.arange(count), values)

    @classmethod
    def of_cameras(cls, cameras: Cameras, image: NDArray[np.int64], own: Array) -> Blocks:
        """A matrix of some cameras [m] alone, [m, 6, 6] each."""
        found = cls.nothing(cameras)
        np.add.at(found.values[:, :POSE, :POSE], image, own)
        return found

    @classmethod
    def from_pairs(
        cls, cameras: int, lenses: int, rows: NDArray[np.int64], columns: NDArray[np.int64], values: Array
    ) -> Blocks:
        """The sum of blocks [p, w, w] of pairs of parts, rows not after columns."""
        count = cameras + lenses
        keys, at = np.unique(rows * count + columns, return_inverse=True)
        total = np.zeros((len(keys), *values.shape[1:]))
        np.add.at(total, at, values)
        return cls(cameras, lenses, np.searchsorted(keys, np.arange(count + 1) * count), keys % count, total)

    @property
    def parts(self) -> int:
        return self.cameras + self.lenses

    @property
    def rows(self) -> NDArray[np.int64]:
        """The part [b] of each block's rows."""
        return np.repeat(np.arange(self.parts), np.diff(self.begin))

    @property
    def arrays(self) -> tuple[Array, NDArray[np.int64], NDArray[np.int64]]:
        """What `add_block` takes."""
        return self.values, self.begin, self.other

    @property
    def zero(self) -> Blocks:
        """The same blocks, all zero."""
        return replace(self, values=np.zeros_like(self.values))

    def __add__(self, more: Blocks) -> Blocks:
        if np.array_equal(self.other, more.other) and np.array_equal(self.begin, more.begin):
            return replace(self, values=self.values + more.values)
        ours, theirs = (each.rows * self.parts + each.other for each in (self, more))
        keys = np.union1d(ours, theirs)
        values = np.zeros((len(keys), *self.values.shape[1:]))
        values[np.searchsorted(keys, ours)] += self.values
        values[np.searchsorted(keys, theirs)] += more.values
        begin = np.searchsorted(keys, np.arange(self.parts + 1) * self.parts)
        return replace(self, begin=begin, other=keys % self.parts, values=values)

    def __mul__(self, factor: float) -> Blocks:
        return replace(self, values=self.values * factor)

    @property
    def diagonal(self) -> Array:
        """The diagonal [6n + 8g]."""
        return self.in_a_row(np.diagonal(self.values[self.begin[:-1]], axis1=1, axis2=2))

    def with_diagonal(self, more: Array) -> Blocks:
        """The matrix with numbers [6n + 8g] added to the diagonal."""
        values = self.values.copy()
        values[self.begin[:-1]] += self.by_part(more)[:, :, None] * np.eye(values.shape[1])
        return replace(self, values=values)

    def scaled(self, unit: Array) -> Blocks:
        """The matrix with rows and columns multiplied by numbers [6n + 8g]."""
        by = self.by_part(unit)
        return replace(self, values=self.values * by[self.rows][:, :, None] * by[self.other][:, None, :])

    def by_part(self, unknowns: Array) -> Array:
        """Numbers [6n + 8g, ...] of all unknowns as [n + g, w, ...], zero beyond a camera's."""
        found = np.zeros((self.parts, self.values.shape[1], *unknowns.shape[1:]))
        poses, lenses = np.split(unknowns, [POSE * self.cameras])
        found[: self.cameras, :POSE] = poses.reshape(self.cameras, POSE, *unknowns.shape[1:])
        found[self.cameras :] = lenses.reshape(self.lenses, *found.shape[1:])
        return found

    def in_a_row(self, by_part: Array) -> Array:
        """The inverse of `by_part`."""
        poses, lenses = by_part[: self.cameras, :POSE], by_part[self.cameras :]
        return np.concatenate([each.reshape(-1, *by_part.shape[2:]) for each in (poses, lenses)])

    def dense(self) -> Array:
        """The full matrix [6n + 8g, 6n + 8g]."""
        width = self.values.shape[1]
        whole = np.zeros((self.parts, width, self.parts, width))
        whole[self.other, :, self.rows] = self.values.transpose(0, 2, 1)
        whole[self.rows, :, self.other] = self.values
        by_column = self.in_a_row(whole.reshape(self.parts, width, -1)).T
        return np.ascontiguousarray(self.in_a_row(by_column.reshape(self.parts, width, -1)))


def tied_parts(
    count: int, start: NDArray[np.int64], parts: NDArray[np.int64], most: int | None = None
) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """`Blocks.begin` and `Blocks.other` of so many parts, with a block for all that are seen together.

    Args:
        start, parts: as `Blocks.tied` has them.
        most: with more blocks than this, they are only counted, and `other` is empty.
    """
    flat = parts.reshape(-1)
    groups = np.repeat(np.arange(len(start) - 1), np.diff(start) * parts.shape[1])
    group = groups[np.argsort(flat, kind="stable")]
    of_part = np.concatenate([[0], np.cumsum(np.bincount(flat, minlength=count))])
    begin, other = np.zeros(count + 1, np.int64), np.zeros(0, np.int64)
    seen_together(start, parts, of_part, group, begin, other)
    if most is None or begin[-1] <= most:
        other = np.empty(begin[-1], np.int64)
        seen_together(start, parts, of_part, group, begin, other)
    return begin, other


def _room(blocks: int, lenses: int) -> Array:
    width = LENS if lenses else POSE
    return np.zeros((blocks, width, width))
