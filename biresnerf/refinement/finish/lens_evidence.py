"""What is known of a set's lenses before all cameras are adjusted, and what follows from the adjustment."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from biresnerf.arrays import Array
from biresnerf.data.model.dataset import Dataset
from biresnerf.geometry.camera.camera_models import REFINED_PARAMETERS, Camera
from biresnerf.geometry.camera.lens import lens_problem
from biresnerf.options.refine_options import RefineIntrinsics
from biresnerf.refinement.adjustment.adjustment import Adjustment, adjust_poses, misfit
from biresnerf.refinement.adjustment.choice import judged
from biresnerf.refinement.adjustment.evidence import Evidence, PosePrior
from biresnerf.refinement.adjustment.lens.corrected_camera import corner, corrected_camera
from biresnerf.refinement.adjustment.lens.lenses import (
    ASPECT,
    CENTRE,
    FOCAL,
    K1,
    K2,
    LENS,
    TANGENTIAL,
    Lenses,
)
from biresnerf.refinement.numbers.finish import EvidenceNumbers
from biresnerf.refinement.parameters.intrinsics_parameters import FocalCertainty

# The parameters that some models lack.
OF_MODELS = {K1: "k1", K2: "k2", 5: "p1", 6: "p2", ASPECT: "fy"}


def lenses_before(dataset: Dataset, option: RefineIntrinsics, numbers: EvidenceNumbers) -> Lenses:
    """The lens parameters that may move, and how well they are known: all not given, or as the option says.

    A lens that was given keeps its model; one that was not may get any.
    """
    deviation = np.zeros((len(dataset.cameras), LENS))
    for i, camera in enumerate(dataset.cameras):
        source = dataset.source_of_intrinsics(i)
        if option == "none" or (option == "auto" and source == "given"):
            continue
        deviation[i, FOCAL] = numbers.focal_deviation(source)
        if option != "focal":
            far, lens = corner(camera), camera.full()
            deviation[i, [K1, K2]] = numbers.radial_deviation / far**2, numbers.radial_deviation / far**4
            deviation[i, TANGENTIAL] = numbers.tangential_deviation / far
            deviation[i, CENTRE] = numbers.centre_deviation * max(camera.width, camera.height) / lens.fx
            deviation[i, ASPECT] = numbers.aspect_deviation
            if source == "given":
                names = REFINED_PARAMETERS[camera.model]
                lacking = [number for number, name in OF_MODELS.items() if name not in names]
                deviation[i, lacking] = 0.0
    return _lenses(dataset, deviation)


def given_focals(dataset: Dataset, option: RefineIntrinsics, numbers: EvidenceNumbers) -> Lenses:
    """Lenses in which only those focal lengths may move that are otherwise kept as given."""
    given = [dataset.source_of_intrinsics(i) == "given" for i in range(len(dataset.cameras))]
    deviation = np.zeros((len(given), LENS))
    deviation[given if option == "auto" else [], 0] = numbers.focal_deviation("given")
    return _lenses(dataset, deviation)


def _lenses(dataset: Dataset, deviation: Array) -> Lenses:
    of_image = np.array([frame.camera for frame in dataset.frames], np.int64)
    return Lenses(of_image, np.zeros_like(deviation), deviation)


def corrected_cameras(cameras: Sequence[Camera], correction: Array) -> tuple[Camera, ...] | None:
    """Cameras after corrections [g, 8]; None where one would be no valid lens."""
    found = tuple(corrected_camera(c, row) for c, row in zip(cameras, correction, strict=True))
    problems = (lens_problem(camera.full(), camera.width, camera.height) for camera in found)
    return None if any(problem is not None for problem in problems) else found


def focal_certainty(
    found: Adjustment | None, evidence: Evidence, contradicted: Sequence[FocalCertainty | None]
) -> tuple[FocalCertainty | None, ...]:
    """What an adjustment to the evidence says of each camera's focal length; None where it is not to move.

    Args:
        contradicted: the result for those that are not to move.
    """
    if found is None or found.lenses is None or evidence.lenses is None:
        return tuple(contradicted)
    deviation, observable = found.lenses.deviation[:, 0], found.lenses.observable[:, 0]
    return tuple(
        FocalCertainty(_known(deviation[i]), bool(observable[i])) if free else contradicted[i]
        for i, free in enumerate(evidence.lenses.free[:, 0].tolist())
    )


def contradicted_focals(
    world_from_cam: Array,
    fitted: Evidence,
    left_out: Evidence,
    prior: PosePrior,
    noise_px: float,
    kept: Lenses,
    by_tracks: Adjustment | None,
) -> list[FocalCertainty | None]:
    """What tracks say about focal lengths that are `kept` as given, by freeing them; None for the others.

    They are contradicted where tracks that were left out agree.

    Args:
        by_tracks: the poses adjusted to the same tracks.
    """
    said: list[FocalCertainty | None] = [None] * len(kept.deviation)
    if fitted.tracks is None or left_out.tracks is None or not kept.free.any():
        return said
    held = by_tracks if fitted.lenses is None else None
    fitted, left_out = replace(fitted, patches=None, lenses=None), replace(left_out, patches=None)
    held = held or adjust_poses(world_from_cam, fitted, prior)
    freed = adjust_poses(held.world_from_cam, replace(fitted, lenses=kept), prior)
    if freed.lenses is None:
        return said
    with_lens = replace(left_out, lenses=kept.known(freed.lenses.correction))
    found = judged(
        misfit(held.world_from_cam, left_out, noise_px), misfit(freed.world_from_cam, with_lens, noise_px)
    )
    for i in np.flatnonzero(kept.free[:, 0]).tolist():
        off, deviation = freed.lenses.correction[i, 0], freed.lenses.deviation[i, 0]
        observable = bool(freed.lenses.observable[i, 0])
        clear = (
            observable
            and found == "better"
            and abs(off) > fitted.numbers.focal_contradicted * np.hypot(kept.deviation[i, 0], deviation)
        )
        said[i] = FocalCertainty(_known(deviation), observable, float(np.exp(off)) if clear else None)
    return said


def _known(deviation: float) -> float | None:
    return float(deviation) if np.isfinite(deviation) else None
