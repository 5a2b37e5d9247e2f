"""Systems over cameras and lenses solved front by front (Duff and Reid 1983), and the blocks of their inverses."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from biresnerf.arrays import Array
from biresnerf.data.points.tracks import components
from biresnerf.refinement.adjustment.cameras import POSE
from biresnerf.refinement.adjustment.solver.blocks import Blocks
from biresnerf.refinement.adjustment.solver.dissection import Front, fronts_of

Unknowns = NDArray[np.int64]


@dataclass(frozen=True, eq=False)
class _Eliminated:
    """A front, with L L^T its own o unknowns' matrix.

    Attributes:
        own, around: numbers of the free unknowns, by part.
        factor: L [o, o]; of the last front, which is not eliminated, its matrix [o + e, o + e] with the border.
        through: L^-1 times the columns of what is around, and of the border, [o, a + e].
    """

    own: Unknowns
    around: Unknowns
    factor: Tensor
    through: Tensor


def solution(matrix: Blocks, right: Array, free: NDArray[np.bool_]) -> Array | None:
    """x [u] with matrix x = right, zero where an unknown is not free; None where it is not positive definite."""
    fronts = _eliminated(matrix, free, right[:, None])
    if fronts is None:
        return None
    x = torch.zeros(matrix.values.shape[1] * matrix.parts, dtype=torch.float64)
    last, size = fronts[-1], len(fronts[-1].own)
    factor, failed = torch.linalg.cholesky_ex(last.factor[:size, :size])
    if failed:
        return None
    x[last.own] = torch.cholesky_solve(last.factor[:size, size:], factor)[:, 0]
    for front in reversed(fronts[:-1]):
        known = front.through[:, -1:] - front.through[:, :-1] @ x[front.around][:, None]
        x[front.own] = torch.linalg.solve_triangular(front.factor.T, known, upper=True)[:, 0]
    found = matrix.in_a_row(x.numpy().reshape(matrix.parts, -1))
    return found if np.isfinite(found).all() else None


def inverse_blocks(matrix: Blocks, free: NDArray[np.bool_], border: Array) -> Array | None:
    """Each part's own block [n + g, w, w] of the inverse of [[matrix, H], [H^T, 0]], zero where unknowns are not free.

    From the last front back, each needs the inverse of what is around it alone, which its parent has (Takahashi 1973).
    None where the matrix is not positive definite.

    Args:
        border: H [u, e].
    """
    fronts, tree = _eliminated(matrix, free, border), fronts_of(matrix.begin, matrix.other)
    if fronts is None:
        return None
    width, extra = matrix.values.shape[1], border.shape[1]
    found = np.zeros((matrix.parts * width, width))
    place = np.empty(matrix.parts * width, np.int64)
    inverses: dict[int, Tensor] = {}
    waiting = np.bincount([front.parent for front in tree[:-1]], minlength=len(tree))
    for number in reversed(range(len(tree))):
        front, parent = fronts[number], tree[number].parent
        if parent < 0:
            whole = torch.from_numpy(np.linalg.inv(front.factor.numpy()))
        else:
            above = np.concatenate([fronts[parent].own, fronts[parent].around])
            place[above] = np.arange(len(above))
            at = torch.from_numpy(np.concatenate([place[front.around], len(above) + np.arange(extra)]))
            whole = _with_own(front, inverses[parent][at[:, None], at])
            waiting[parent] -= 1
            if not waiting[parent]:
                del inverses[parent]
        if waiting[number]:
            inverses[number] = whole
        _keep_own(found, front.own, whole.numpy(), width)
    return found.reshape(matrix.parts, width, width)


def _with_own(front: _Eliminated, around: Tensor) -> Tensor:
    """The inverse of a front's own unknowns and what is around it, from that of the latter."""
    across = torch.linalg.solve_triangular(front.factor.T, front.through, upper=True)
    mixed = -across @ around
    own = torch.cholesky_inverse(front.factor) - mixed @ across.T
    return torch.cat([torch.cat([own, mixed], 1), torch.cat([mixed.T, around], 1)])


def _keep_own(found: Array, own: Unknowns, inverse: Array, width: int) -> None:
    """Copy what is within one part."""
    part = own // width
    for first in np.flatnonzero(np.diff(part, prepend=-1)):
        size = int((part[first : first + width] == part[first]).sum())
        rows = own[first : first + size]
        found[rows[:, None], rows % width] = inverse[first : first + size, first : first + size]


def _eliminated(matrix: Blocks, free: NDArray[np.bool_], border: Array) -> list[_Eliminated] | None:
    tree, width, extra = fronts_of(matrix.begin, matrix.other), matrix.values.shape[1], border.shape[1]
    is_free, bordering = matrix.by_part(free.astype(np.float64)).reshape(-1) > 0, matrix.by_part(border)
    bordering = bordering.reshape(len(is_free), extra)
    place, left = np.empty(len(is_free), np.int64), [list[tuple[Unknowns, Tensor]]() for _ in tree]
    found = list[_Eliminated]()
    for front in tree:
        own, around = (_free_unknowns(parts, width, is_free) for parts in (front.own, front.around))
        here, size = np.concatenate([own, around]), len(own)
        whole = np.zeros((len(here) + extra,) * 2)
        whole[: len(here), : len(here)] = _entries(matrix, front, is_free)
        whole[:size, len(here) :] = bordering[own]
        whole[len(here) :, :size] = bordering[own].T
        place[here] = np.arange(len(here))
        total = torch.from_numpy(whole)
        for unknowns, more in left[len(found)]:
            at = torch.from_numpy(np.concatenate([place[unknowns], len(here) + np.arange(extra)]))
            total[at[:, None], at] += more
        left[len(found)].clear()
        if front.parent < 0:
            found.append(_Eliminated(own, around, total, total[:0]))
            break
        factor, failed = torch.linalg.cholesky_ex(total[:size, :size])
        if failed:
            return None
        through = torch.linalg.solve_triangular(factor, total[:size, size:], upper=False)
        left[front.parent].append((around, total[size:, size:] - through.T @ through))
        found.append(_Eliminated(own, around, factor, through))
    return found


def _free_unknowns(parts: NDArray[np.int64], width: int, free: NDArray[np.bool_]) -> Unknowns:
    unknowns = (width * parts[:, None] + np.arange(width)).reshape(-1)
    return np.asarray(unknowns[free[unknowns]])


def _entries(matrix: Blocks, front: Front, free: NDArray[np.bool_]) -> Array:
    """The entries of the matrix for a front's free unknowns, its own first."""
    width, parts = matrix.values.shape[1], np.concatenate([front.own, front.around])
    whole = np.zeros((len(parts), width, len(parts), width))
    values = matrix.values[front.blocks]
    whole[front.columns, :, front.rows] = values.transpose(0, 2, 1)
    whole[front.rows, :, front.columns] = values
    kept = free.reshape(-1, width)[parts].reshape(-1)
    square = whole.reshape(len(kept), len(kept))
    return square if kept.all() else square[np.ix_(kept, kept)]


def peak_bytes(begin: Unknowns, other: Unknowns, width: int = POSE) -> int:
    """The most memory that `solution` and `inverse_blocks` take beside a matrix of such `Blocks`."""
    tree = fronts_of(begin, other)
    own = width * np.array([len(front.own) for front in tree])
    around = width * np.array([len(front.around) for front in tree])
    whole, factors = (own + around) ** 2, int((own * (own + around)).sum())
    left = [0] * len(tree)
    waiting = most = 0
    for number, front in enumerate(tree):  # what a front leaves waits for its parent
        most = max(most, waiting + 2 * whole[number])
        waiting -= left[number]
        if front.parent >= 0:
            left[front.parent] += around[number] ** 2
            waiting += around[number] ** 2
    children = np.bincount([front.parent for front in tree[:-1]], minlength=len(tree))
    kept = 0
    for number in reversed(range(len(tree))):  # a front's inverse waits for its children
        most = max(most, kept + 2 * whole[number])
        kept += whole[number] if children[number] else 0
        parent = tree[number].parent
        if parent >= 0:
            children[parent] -= 1
            kept -= 0 if children[parent] else whole[parent]
    return 8 * (factors + int(most))


def largest_group(matrix: Blocks) -> NDArray[np.bool_]:
    """Which cameras [n] evidence ties together, directly or through others; of several groups the largest."""
    tied = (matrix.values != 0).any(axis=(1, 2)) & (matrix.other < matrix.cameras)
    group = components(matrix.cameras, matrix.rows[tied], matrix.other[tied])
    return np.asarray(group == np.bincount(group).argmax())
