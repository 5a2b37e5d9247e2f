"""The choice between sets of poses, by evidence that none of them was fitted to."""

from __future__ import annotations

import logging
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from biresnerf.arrays import Array
from biresnerf.judging.compare import LEFT_OUT, compare, octaves
from biresnerf.refinement.adjustment.lens.lenses import Lenses
from biresnerf.report import CandidateName, CandidateReport, Finding

logger = logging.getLogger(__name__)


_LEAST = 1e-6  # of a misfit, in squared noise levels: nothing fits better than that


@dataclass(frozen=True, eq=False)
class Candidate:
    """Poses that a result could hold.

    Attributes:
        world_from_cam: [n, 4, 4], in the frame and scale of the others.
        lenses: None: as the evidence has them.
    """

    name: CandidateName
    world_from_cam: Array
    lenses: Lenses | None = None


@dataclass(frozen=True, eq=False)
class Choice:
    """The candidate chosen, and how all of them did."""

    chosen: Candidate
    reports: tuple[CandidateReport, ...]


def choose(
    candidates: Sequence[Candidate],
    misfits: Mapping[str, Array],
    alike: Mapping[str, NDArray[np.bool_]] | None = None,
    first: int = 0,
) -> Choice:
    """The candidate that left-out evidence supports.

    A candidate is beaten by one that fits some kind of evidence better and none worse, beyond chance over cameras. The
    first is kept unless something beats it: then the first one that beats it, and that nothing beats, is taken.

    Args:
        candidates: in the order in which they are kept on a tie.
        misfits: of each kind of evidence (``tracks``, ``patches``), [candidates, n]: each camera's mean robust square
            in noise levels; NaN where it does not know the camera.
        alike: bool [candidates] by kind: candidates that such evidence cannot distinguish, whatever it fits.
        first: index of the candidate that is kept on a tie.
    """
    reports = tuple(
        CandidateReport(
            name=candidate.name,
            track_misfit=_median(misfits.get("tracks"), i),
            patch_misfit=_median(misfits.get("patches"), i),
        )
        for i, candidate in enumerate(candidates)
    )
    count = range(len(candidates))
    beats = np.array([[_beats(misfits, alike or {}, i, j) for j in count] for i in count])
    better = np.flatnonzero(beats[:, first] & ~beats.any(0))
    best = int(better[0]) if len(better) else first
    logger.info(
        "poses: %s of %s", candidates[best].name,
        ", ".join(f"{r.name} ({r.track_misfit}, {r.patch_misfit})" for r in reports),
    )  # fmt: skip
    reports = tuple(r.model_copy(update={"chosen": i == best}) for i, r in enumerate(reports))
    return Choice(candidates[best], reports)


def _beats(
    misfits: Mapping[str, Array], alike: Mapping[str, NDArray[np.bool_]], one: int, other: int
) -> bool:
    """Whether a candidate fits some kind of evidence better than another one, and none worse."""
    found = [
        judged(misfit[other], misfit[one])
        for kind, misfit in misfits.items()
        if kind not in alike or not alike[kind][[one, other]].all()
    ]
    return "better" in found and "worse" not in found


def judged(before: Array, after: Array) -> Finding:
    """What misfits [n] of one set of poses and another say about the latter, by the cameras known in both."""
    known = np.isfinite(before) & np.isfinite(after)
    return compare(octaves(before[known], after[known], _LEAST) / 2, LEFT_OUT).finding


def _median(misfit: Array | None, candidate: int) -> float | None:
    """Over cameras; None where none is known."""
    known = np.zeros(0) if misfit is None else misfit[candidate][np.isfinite(misfit[candidate])]
    return float(np.median(known)) if len(known) else None
