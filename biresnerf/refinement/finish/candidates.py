"""Poses that a result could hold: the input's, those of matches, the refined ones, and adjusted ones."""

from __future__ import annotations

import logging
from collections.abc import Callable, Sequence
from dataclasses import replace

import numpy as np

from biresnerf.arrays import Array
from biresnerf.geometry.camera.camera_models import Camera
from biresnerf.geometry.rigid_bodies import RigidBodies
from biresnerf.geometry.similarity import align_robust
from biresnerf.refinement.adjustment.adjustment import Adjustment, Halves, adjust_poses
from biresnerf.refinement.adjustment.choice import Candidate
from biresnerf.refinement.adjustment.evidence import Evidence, PosePrior
from biresnerf.refinement.finish.lens_evidence import corrected_cameras
from biresnerf.refinement.scene.scene import Scene
from biresnerf.report import CandidateName

logger = logging.getLogger(__name__)


# On a tie the earlier is kept: the input's poses, unless the evidence cannot decide.
ORDER: tuple[CandidateName, ...] = (
    "input", "refined", "adjusted", "adjusted-patches", "adjusted-tracks", "matched",
)  # fmt: skip
# Candidates that patches were to be trusted for, and that patches left out prefer: photos have confirmed them.
BY_PATCHES: tuple[CandidateName, ...] = ("adjusted", "adjusted-patches")
BY_TRACKS: tuple[CandidateName, ...] = ("adjusted", "adjusted-tracks")


def adjust(
    refined: Array,
    evidence: Evidence,
    prior: PosePrior,
    announce: Callable[[], None],
    halves: Halves | None = None,
) -> dict[CandidateName, Adjustment]:
    """Adjustments to tracks, to patches and to both; ``halves`` of the patches where they are known."""
    found: dict[CandidateName, Adjustment] = {}

    def add(name: CandidateName, evidence: Evidence, halves: Halves | None = None) -> Adjustment:
        announce()
        found[name] = result = adjust_poses(refined, evidence, prior, halves)
        logger.info("%s: %s", name, _described(result))
        return result

    if evidence.tracks:
        add("adjusted-tracks", replace(evidence, patches=None))
    if evidence.patches:
        patched = add("adjusted-patches", replace(evidence, tracks=None), halves)
        if evidence.tracks and usable(patched):
            add("adjusted", evidence, patched.halves)
    return found


def as_candidate(
    name: CandidateName, found: Adjustment, evidence: Evidence, cameras: Sequence[Camera]
) -> Candidate | None:
    """An adjustment as a candidate; None where it is not to be believed, or a corrected camera has no valid lens."""
    if not usable(found):
        return None
    if found.lenses is None or evidence.lenses is None or not found.lenses.correction.any():
        return Candidate(name, found.world_from_cam)
    if corrected_cameras(cameras, found.lenses.correction) is None:
        return None
    return Candidate(name, found.world_from_cam, evidence.lenses.known(found.lenses.correction))


def usable(found: Adjustment) -> bool:
    """Whether an adjustment is to be believed."""
    return found.used and (found.halves is None or found.halves.trusted)


def _described(found: Adjustment) -> str:
    return (
        f"tracks {found.track_noise_px:.2f} px, {found.track_inliers:.2f} of them within, "
        f"patches {found.patch_inliers:.2f}, {found.halves}"
    )


def without_adjustment(scene: Scene, refined: Array, bodies: RigidBodies) -> list[Candidate]:
    """The input's poses, and those of matches where there are any, carried to the refined ones' frame and bodies."""
    given: list[tuple[CandidateName, Array | None]] = [
        ("input", scene.dataset.world_from_cam),
        ("matched", scene.start.matched_poses),
    ]
    return [
        Candidate(
            name,
            bodies.held(align_robust(poses, refined, with_rotations=True).apply_to_poses(poses), refined),
        )
        for name, poses in given
        if poses is not None and np.isfinite(poses).all()
    ]
