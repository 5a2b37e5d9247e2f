"""Adjusts rigs of `camera_rigs` with Ceres through pycolmap, with 6-D pose priors through pyceres."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from benchmarks.large.camera_rigs import CAMERA, OFF, OFF_RAD, SIZE, Rig
from biresnerf.geometry.rigid import rigid_inverse
from biresnerf.refinement.adjustment.cameras import Cameras
from biresnerf.refinement.adjustment.solver.solve import CONVERGED, ROUNDS, SETTLED
from biresnerf.refinement.adjustment.track_term import ROBUST_SCALE, TrackTerm

Array = NDArray[np.float64]


def adjusted(given: Rig) -> Array:
    """Poses [n, 4, 4] (world from cam). The noise is measured outside of Ceres, as ours is, and Ceres run again."""
    poses, noise = given.given, 0.0
    for _ in range(ROUNDS):
        term = _settled(given, poses)
        before, noise = noise, term.noise_px
        if abs(noise / max(before, 1e-9) - 1) < SETTLED:
            break
        poses = _round(given, poses, term)
    return poses


def _round(given: Rig, poses: Array, term: TrackTerm) -> Array:
    import pyceres  # before pycolmap, whose types of Ceres it defines
    import pycolmap
    import pycolmap.cost_functions

    reconstruction = _reconstruction(given, poses, term)
    options, config = pycolmap.BundleAdjustmentOptions(), pycolmap.BundleAdjustmentConfig()
    options.refine_focal_length = options.refine_extra_params = options.print_summary = False
    options.ceres.loss_function_type = pycolmap.LossFunctionType.CAUCHY
    options.ceres.loss_function_scale = ROBUST_SCALE * term.noise_px / 2**0.5
    options.ceres.solver_options.num_threads = 1
    options.ceres.solver_options.function_tolerance = CONVERGED
    for image in reconstruction.images:
        config.add_image(image)
    adjuster = pycolmap.create_default_ceres_bundle_adjuster(options, config, reconstruction)
    problem: pyceres.Problem = adjuster.problem
    # Of rotation and centre, in the camera's axes. Our objective is in noise levels, Ceres' in px.
    covariance = np.diag([OFF_RAD**2] * 3 + [OFF**2] * 3) / term.noise_px**2
    for number, pose in enumerate(rigid_inverse(given.given)):
        prior = pycolmap.cost_functions.AbsolutePosePriorCost(covariance, pycolmap.Rigid3d(pose[:3]))
        problem.add_residual_block(prior, None, [reconstruction.frames[number + 1].rig_from_world.params])
    adjuster.solve()
    found = [reconstruction.images[number + 1].cam_from_world().matrix() for number in range(len(poses))]
    bottom = np.tile([[[0.0, 0.0, 0.0, 1.0]]], (len(found), 1, 1))
    return np.asarray(rigid_inverse(np.concatenate([np.stack(found), bottom], 1)))


def _settled(given: Rig, poses: Array) -> TrackTerm:
    """The best-fitting points, and the noise."""
    cameras, tracks = Cameras.of(poses), given.evidence.tracks
    assert tracks is not None
    term = TrackTerm(tracks, given.evidence.intrinsics, cameras)
    term.measure(cameras)
    return term


def _reconstruction(given: Rig, poses: Array, term: TrackTerm) -> Any:
    import pycolmap

    tracks = given.evidence.tracks
    assert tracks is not None
    reconstruction = pycolmap.Reconstruction()
    camera = pycolmap.Camera(
        camera_id=1, model="PINHOLE", width=SIZE, height=SIZE, params=list(CAMERA.params)
    )
    reconstruction.add_camera_with_trivial_rig(camera)
    place = np.zeros(len(tracks.image), np.int64)
    for number, pose in enumerate(rigid_inverse(poses)):
        own = np.flatnonzero(tracks.image == number)
        place[own] = np.arange(len(own))
        image = pycolmap.Image(
            name=f"{number}",
            camera_id=1,
            image_id=number + 1,
            points2D=[pycolmap.Point2D(xy) for xy in tracks.xy[own]],
        )
        reconstruction.add_image_with_trivial_frame(image, pycolmap.Rigid3d(pose[:3]))
    for point, (first, last) in enumerate(zip(term.start[:-1], term.start[1:], strict=True)):
        track = pycolmap.Track()
        for at in range(first, last):
            track.add_element(int(tracks.image[at]) + 1, int(place[at]))
        reconstruction.add_point3D(term.unknowns[point], track, np.zeros(3, np.uint8))
    return reconstruction
