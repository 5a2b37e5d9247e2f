"""The evidence of a run that all cameras are adjusted to, and the part left out to judge by."""

from __future__ import annotations

from contextlib import suppress
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from biresnerf.arrays import Array
from biresnerf.data.model.dataset import Dataset
from biresnerf.data.points.located_points import located
from biresnerf.data.points.tracks import Tracks
from biresnerf.geometry.camera.camera import Intrinsics
from biresnerf.geometry.earth.georeference import NoGeoreference, fit_positions
from biresnerf.options.refine_options import RefineIntrinsics, ResolvedOptions
from biresnerf.refinement.adjustment.evidence import Control, Evidence, Positions
from biresnerf.refinement.adjustment.ideal import ideal_cameras, straight_tracks
from biresnerf.refinement.finish.lens_evidence import lenses_before
from biresnerf.refinement.finish.photo_evidence import photo_patches
from biresnerf.refinement.numbers.finish import EvidenceNumbers
from biresnerf.refinement.optimise.renderer import Renderer
from biresnerf.refinement.parameters.joint_parameters import JointParameters
from biresnerf.refinement.scene.scene import Scene


@dataclass(frozen=True, eq=False)
class SplitEvidence:
    """Evidence in two parts.

    Attributes:
        fitted, left_out: what candidates are adjusted to, and what they are judged by.
        tracks: those of both parts and the surplus; the returned poses are adjusted to them.
        placed: bool [n], cameras no longer at a guessed pose; the evidence is of their photos alone.
    """

    fitted: Evidence
    left_out: Evidence
    tracks: Tracks | None
    placed: NDArray[np.bool_]


def gather_evidence(
    scene: Scene,
    renderer: Renderer,
    options: ResolvedOptions,
    placed: NDArray[np.bool_],
    numbers: EvidenceNumbers,
) -> SplitEvidence:
    """Tracks and patches for ideal cameras; of the cameras placed [n] alone."""
    split = without_patches(scene, renderer.joint, options.refine_intrinsics, placed, numbers)
    intrinsics = _intrinsics(renderer.joint.lenses.refined(scene.dataset))
    patches = photo_patches(scene, renderer, options, intrinsics, split.fitted, placed)
    if patches is None:
        return split
    spared = np.arange(len(patches)) % numbers.left_out_one_in == 0
    return replace(
        split,
        fitted=replace(split.fitted, patches=patches.of(~spared)),
        left_out=replace(split.left_out, patches=patches.of(spared)),
    )


def without_patches(
    scene: Scene,
    joint: JointParameters,
    refined: RefineIntrinsics,
    placed: NDArray[np.bool_],
    numbers: EvidenceNumbers,
) -> SplitEvidence:
    """Tracks for ideal cameras, and what was measured beside photos; of the cameras placed [n] alone.

    Photos of another scene match each other, and could outweigh the scene's own.
    """
    dataset = joint.lenses.refined(scene.dataset)
    intrinsics = _intrinsics(dataset)
    ideal = ideal_cameras(intrinsics)
    before = lenses_before(scene.dataset, refined, numbers)
    fitted: Tracks | None = None
    judging: Tracks | None = None
    tracks = scene.tracks and scene.tracks.where(placed[scene.tracks.image])
    if tracks is not None:
        tracks = straight_tracks(tracks, intrinsics, ideal)
        fitted, judging = tracks.split()
        more = max(1.0, len(dataset) / numbers.up_to_cameras)
        tracks = tracks.thinned(round(more * numbers.most_in_the_end), len(dataset))
        fitted = fitted and fitted.thinned(round(more * numbers.most_observations), len(dataset))
    measured = measured_evidence(dataset, joint.unit_from_cam, placed, numbers)
    return SplitEvidence(
        replace(measured, tracks=fitted, lenses=before if before.free.any() else None),
        Evidence(ideal, judging, numbers=numbers),
        tracks,
        placed,
    )


def _intrinsics(dataset: Dataset) -> Intrinsics:
    """The intrinsics of each image."""
    return Intrinsics.from_cameras([dataset.camera_of(i) for i in range(len(dataset))])


def measured_evidence(
    dataset: Dataset, poses: Array, placed: NDArray[np.bool_], numbers: EvidenceNumbers
) -> Evidence:
    """The measured places of a set, where they fix a frame of placed cameras [n] at these poses [n, 4, 4].

    Without positions far beyond the others, and without check points.
    """
    intrinsics = _intrinsics(dataset)
    evidence = Evidence(ideal_cameras(intrinsics), numbers=numbers)
    if not np.isfinite(poses).all():
        return evidence
    if dataset.positions is not None:
        priors = dataset.positions.of(placed)
        with suppress(NoGeoreference):
            used = fit_positions(poses[priors.rows], priors.positions_m).used
            positions = Positions.of(priors.rows[used], priors.positions_m[used], priors.accuracy_m[used])
            evidence = replace(evidence, positions=positions)
    if dataset.control is not None:
        with suppress(NoGeoreference):
            points = dataset.control.of(placed)
            located(points, poses, [dataset.camera_of(i) for i in range(len(dataset))])
            points = points.seen_in(~points.check[points.point])
            tracks = straight_tracks(
                Tracks(points.point, points.image, points.xy), intrinsics, evidence.intrinsics
            )
            evidence = replace(evidence, control=Control.of(tracks, points.metres, points.accuracy_m))
    return evidence
