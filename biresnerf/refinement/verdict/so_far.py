"""The poses that a run offers before its end: the best so far, by what can be measured on the way."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
import torch
from numpy.typing import NDArray

from biresnerf.data.model.dataset import Dataset
from biresnerf.judging.compare import LATER_MATCH_ERRORS, compare
from biresnerf.refinement.finish.expected_errors import expected_errors
from biresnerf.refinement.finish.gather_evidence import without_patches
from biresnerf.refinement.optimise.camera_errors import CameraErrors
from biresnerf.refinement.optimise.methods import Recipe
from biresnerf.refinement.parameters.joint_parameters import JointParameters
from biresnerf.refinement.scene.scene import Scene
from biresnerf.refinement.stages.checkpoint import BestSoFar
from biresnerf.refinement.stages.run_state import RunState
from biresnerf.refinement.start.refined_poses import RefinedPoses
from biresnerf.refinement.verdict.judgement import compare_without_training
from biresnerf.refinement.verdict.verdict import decide, matches_are_better
from biresnerf.report import Verdict

UNMEASURED = (
    "Nothing measures poses before the end of a run without feature matches: these are the latest ones."
)


@dataclass(frozen=True, eq=False)
class SoFar:
    """What a run offers at one moment.

    Attributes:
        refined: the best refined poses so far; the latest where none were better than the input's yet.
        verdict: on these; None where the options ask for none.
    """

    refined: RefinedPoses
    verdict: Verdict | None

    def offered(self, scene: Scene) -> tuple[NDArray[np.float64], Dataset]:
        """Poses [n, 4, 4] and the set with their lenses: the input's, unless others are better."""
        if self.verdict is not None and self.verdict.returned == "input":
            return scene.dataset.world_from_cam, scene.dataset
        return self.refined.world_from_cam, self.refined.dataset


def poses_so_far(
    scene: Scene, joint: JointParameters, camera_errors: CameraErrors, recipe: Recipe, run: RunState
) -> SoFar:
    """Measure the present poses, keep them if they are the best, and return the best.

    The input's poses come first, then any that the verdict's rule returns. Later ones replace these unless matches show
    that they are significantly worse than the best ever measured. No field is trained: this takes as long as a few
    steps.
    """
    best, now = run.record.best, RefinedPoses.now(scene.dataset, joint)
    if not recipe.options.verdict:
        return SoFar(now, None)
    verdict = _verdict(scene, joint, camera_errors, recipe, now)
    gain = 0.0 if verdict.epipolar is None else verdict.epipolar.error_px.difference
    worse = best is not None and compare(gain - best.gain, LATER_MATCH_ERRORS).finding == "worse"
    if verdict.returned == "refined" and not worse:
        best = BestSoFar(
            unit_from_cam=joint.unit_from_cam.copy(),
            increments=joint.lenses.increments.detach().cpu().numpy().copy(),
            verdict=verdict,
            gain=gain if best is None else max(gain, best.gain),
        )
        run.note(best=best)
        return SoFar(now, verdict)
    if best is None:
        return SoFar(now, verdict)
    lenses = joint.lenses.at(torch.from_numpy(best.increments))
    return SoFar(RefinedPoses.at(scene.dataset, joint, best.unit_from_cam, lenses), best.verdict)


def _verdict(
    scene: Scene, joint: JointParameters, camera_errors: CameraErrors, recipe: Recipe, refined: RefinedPoses
) -> Verdict:
    """The verdict by all but unseen views; where nothing supports or contradicts them, refined poses are offered."""
    lost, method = int(camera_errors.lost.sum()), recipe.method
    findings = compare_without_training(scene, refined, lost, method).findings
    if matches_are_better(findings) and method.uncertainty:
        placed, of_lenses = camera_errors.placed, recipe.options.refine_intrinsics
        evidence = without_patches(scene, joint, of_lenses, placed, method.evidence).fitted
        errors = expected_errors(joint.unit_from_cam, joint.unit_from_cam, evidence, bodies=joint.bodies)
        findings = replace(findings, determined=float(errors.known.mean()))
    verdict = decide(findings)
    if findings.epipolar is not None or verdict.verdict != "inconclusive":
        return verdict
    return verdict.model_copy(update={"returned": "refined", "why": (UNMEASURED, *verdict.why)})
