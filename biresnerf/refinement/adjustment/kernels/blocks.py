"""Blocks of cameras and lenses that are seen together: their pattern, their sums, and paths along them.

`begin` and `other` are those of `biresnerf.refinement.adjustment.solver.blocks`.
"""

from __future__ import annotations

import numpy as np

from biresnerf.field.numba_kernels import njit
from biresnerf.refinement.adjustment.kernels.compiled import KERNEL


@njit(**KERNEL)
def seen_together(start, parts, of_part, group, begin, other):
    """Fill `begin`, and `other` where it has room: of each part itself, and the later ones of its groups.

    `group` has the groups of each part, from `of_part` on, ascending.
    """
    count, at = len(begin) - 1, 0
    seen = np.full(count, -1)
    for one in range(count):
        begin[one] = at
        seen[one] = one
        if len(other):
            other[at] = one
        at += 1
        for i in range(of_part[one], of_part[one + 1]):
            if i > of_part[one] and group[i] == group[i - 1]:
                continue
            for e in range(start[group[i]], start[group[i] + 1]):
                for k in range(parts.shape[1]):
                    two = parts[e, k]
                    if two > one and seen[two] != one:
                        seen[two] = one
                        if len(other):
                            other[at] = two
                        at += 1
        if len(other):
            other[begin[one] : at].sort()
    begin[count] = at


@njit(inline="always", **KERNEL)
def add_block(system, one, two, offsets, block):
    """Add block [w, w], of two observations' unknowns, where their parts [k] stand in this order, or are the same.

    Each two observations are to be added in both orders.

    Args:
        system: the values, `begin` and `other` of `Blocks`.
        offsets: [w], where unknowns are within their part.
    """
    values, begin, other = system
    width = len(offsets)
    for p in range(len(one)):
        for q in range(len(two)):
            if one[p] > two[q]:
                continue
            low, high = begin[one[p]], begin[one[p] + 1]
            while low < high:
                middle = (low + high) // 2
                if other[middle] < two[q]:
                    low = middle + 1
                else:
                    high = middle
            for a in range(6 * p, 6 if p == 0 else width):
                for b in range(6 * q, 6 if q == 0 else width):
                    values[low, offsets[a], offsets[b]] += block[a, b]


@njit(**KERNEL)
def steps_from(source, begin, other):
    """The number of ties on the shortest path from a part to each [count]; -1 where there is none."""
    steps, queue = np.full(len(begin) - 1, -1), np.empty(len(begin) - 1, np.int64)
    steps[source], queue[0], done, waiting = 0, source, 0, 1
    while done < waiting:
        part = queue[done]
        done += 1
        for i in range(begin[part], begin[part + 1]):
            if steps[other[i]] < 0:
                steps[other[i]] = steps[part] + 1
                queue[waiting] = other[i]
                waiting += 1
    return steps
