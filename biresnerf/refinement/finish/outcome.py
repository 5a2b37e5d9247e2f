"""The results of the adjustment of all cameras."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from biresnerf.arrays import Array
from biresnerf.geometry.rigid_bodies import RigidBodies
from biresnerf.geometry.similarity import Similarity
from biresnerf.refinement.adjustment.adjustment import Adjustment
from biresnerf.refinement.adjustment.choice import Candidate
from biresnerf.refinement.adjustment.evidence import Evidence
from biresnerf.refinement.finish.candidates import ORDER, usable
from biresnerf.refinement.finish.expected_errors import ExpectedErrors, expected_errors
from biresnerf.refinement.finish.given_poses import GivenPoses
from biresnerf.report import CandidateName, CandidateReport


@dataclass(frozen=True, eq=False)
class Fit:
    """Poses [n, 4, 4] in the unit frame that were adjusted to evidence, and the level of its patches' noise."""

    world_from_cam: Array
    evidence: Evidence
    patch_noise: float


@dataclass(frozen=True, eq=False)
class Finish:
    """The result of the adjustment.

    Attributes:
        candidates: the poses that were compared, and how they did.
        fit: of the poses to all evidence that is to be trusted; None where there is none.
        given: how accurate the input's poses are; None where that is not known.
    """

    candidates: tuple[CandidateReport, ...] = ()
    fit: Fit | None = None
    given: GivenPoses | None = None

    @property
    def moved(self) -> bool:
        """Whether other poses are better than those before."""
        return any(each.chosen and each.name != "refined" for each in self.candidates)

    def errors_of(
        self, world_from_cam: Array, world_from_unit: Similarity, bodies: RigidBodies
    ) -> ExpectedErrors | None:
        """The expected errors of poses [n, 4, 4] in the input's frame, in that frame; or None."""
        fit = self.fit
        if fit is None or not np.isfinite(world_from_cam).all():
            return None
        in_unit = world_from_unit.inverse().apply_to_poses(world_from_cam)
        found = expected_errors(in_unit, fit.world_from_cam, fit.evidence, fit.patch_noise, bodies)
        return found.carried(world_from_unit)

    def refused(self) -> Finish:
        """The result if the chosen poses are rejected, and the evidence that prefers them is not believed."""
        kept = (each.model_copy(update={"chosen": each.name == "refined"}) for each in self.candidates)
        return Finish(tuple(kept))


def most_heeded(results: Mapping[CandidateName, Adjustment]) -> Adjustment | None:
    """The credible adjustment that uses most kinds of evidence."""
    return next((results[name] for name in ORDER if name in results and usable(results[name])), None)


def heeded(name: CandidateName, found: Adjustment, evidence: Evidence) -> Evidence:
    """The part of the evidence that an adjustment used, with the lenses that it found."""
    lenses = evidence.lenses
    if lenses is not None and found.lenses is not None:
        lenses = replace(lenses, correction=found.lenses.correction)
    tracks = evidence.tracks if name != "adjusted-patches" else None
    patches = evidence.patches if name != "adjusted-tracks" else None
    return replace(evidence, tracks=tracks, patches=patches, lenses=lenses)


def fit_of(
    candidates: Sequence[Candidate],
    results: Mapping[CandidateName, Adjustment],
    evidence: Mapping[CandidateName, Evidence],
) -> Fit | None:
    """The credible adjusted poses that use most evidence, and that evidence; None where none was credible."""
    name = next((each.name for each in candidates if each.name in results), None)
    if name is None:
        return None
    found, to = results[name], heeded(name, results[name], evidence[name])
    return Fit(found.world_from_cam, to, found.patch_noise if to.patches else 1.0)
