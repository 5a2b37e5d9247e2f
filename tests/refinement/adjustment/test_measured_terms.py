"""Measured places hold the shape of a rig, as far as they are exact, and its frame stays free."""

import numpy as np
import pytest
import torch

from biresnerf.data.points.tracks import Tracks
from biresnerf.geometry.camera.camera import Intrinsics, project
from biresnerf.geometry.camera.camera_models import Camera
from biresnerf.geometry.lie import so3_exp
from biresnerf.geometry.similarity import Similarity, align_points, align_robust
from biresnerf.refinement.adjustment.adjustment import adjust_poses
from biresnerf.refinement.adjustment.cameras import Cameras
from biresnerf.refinement.adjustment.evidence import Control, Evidence, PosePrior, Positions
from biresnerf.refinement.adjustment.lens.lenses import Lenses
from biresnerf.refinement.adjustment.measured_terms import ControlTerm, PositionTerm, measured_misfits
from biresnerf.refinement.adjustment.track_term import TrackTerm

COLUMNS, ROWS, HEIGHT_M, STEP_M = 6, 5, 100.0, 25.0
COUNT = COLUMNS * ROWS
WIDTH, HEIGHT = 1200, 900
# The lens bends by 9 px in the corners, and nobody knows.
LENS = Camera("RADIAL", WIDTH, HEIGHT, (1000.0, 600.0, 450.0, -0.03, 0.01))
GUESS = Intrinsics.from_cameras([Camera("PINHOLE", WIDTH, HEIGHT, (1000.0, 1000.0, 600.0, 450.0))] * COUNT)
FREE = Lenses(np.zeros(COUNT, np.int64), np.zeros((1, 8)), np.array([[0.1] * 3 + [0.01] * 2 + [0.0] * 3]))
METRES_FROM_WORLD = Similarity(
    20.0, np.array([[0.0, -1, 0], [1, 0, 0], [0, 0, 1]]), np.array([5e5, 5e6, 200])
)


def flight(rng):
    """Poses [n, 4, 4] of a drone that looks down on nearly flat land, and what it sees."""
    x, y = np.meshgrid(STEP_M * np.arange(COLUMNS), STEP_M * np.arange(ROWS))
    poses = np.tile(np.eye(4), (COUNT, 1, 1))
    turn = so3_exp(torch.from_numpy(rng.normal(0, 0.02, (COUNT, 3)))).numpy()
    poses[:, :3, :3] = turn @ np.diag([1.0, -1, -1])
    poses[:, :3, 3] = np.stack([x.ravel(), y.ravel(), np.full(COUNT, HEIGHT_M)], 1)
    land = np.column_stack([rng.uniform(-60, 190, 800), rng.uniform(-60, 160, 800), rng.normal(0, 2, 800)])
    tracks = observed_from(poses, land, rng)
    poses[:, :3, 3] += METRES_FROM_WORLD.translation
    return METRES_FROM_WORLD.inverse().apply_to_poses(poses), tracks


def observed_from(poses, land, rng, noise_px=0.5):
    """What photos show of points."""
    point, image = (index.ravel() for index in np.indices((len(land), COUNT)))
    in_cam = np.einsum("mji,mj->mi", poses[image, :3, :3], land[point] - poses[image, :3, 3])
    lenses = Intrinsics.from_cameras([LENS] * COUNT)
    xy = project(lenses, torch.from_numpy(image), torch.from_numpy(in_cam)).numpy()
    seen = ((xy > 0) & (xy < [WIDTH, HEIGHT])).all(1)
    return Tracks.of(point[seen], image[seen], xy[seen] + rng.normal(0, noise_px, (int(seen.sum()), 2)))


def measured(truth, rng, sigma_m, stated_m):
    there = METRES_FROM_WORLD.apply(truth[:, :3, 3]) + rng.normal(0, sigma_m, (COUNT, 3))
    return Positions.of(np.arange(COUNT), there, np.full((COUNT, 3), stated_m))


def marked(truth, rng, sigma_m, points=8, noise_px=0.5):
    """Control points on the land, where hands marked them."""
    land = np.column_stack([rng.uniform(-20, 145, points), rng.uniform(-20, 120, points), np.zeros(points)])
    tracks = observed_from(
        METRES_FROM_WORLD.apply_to_poses(truth), land + METRES_FROM_WORLD.translation, rng, noise_px
    )
    coordinates = land + METRES_FROM_WORLD.translation + rng.normal(0, sigma_m, (points, 3))
    return Control.of(tracks, coordinates, np.full((points, 3), sigma_m))


def adjusted(start, tracks, positions=None, lenses=FREE, control=None):
    prior = PosePrior.equal(start, 1.0, HEIGHT_M / METRES_FROM_WORLD.scale)
    evidence = Evidence(GUESS, tracks, lenses=lenses, positions=positions, control=control)
    return adjust_poses(start, evidence, prior)


def errors_m(poses, truth):
    """Root mean square distance of the centres after alignment, m."""
    apart = align_robust(poses, truth).apply_to_poses(poses)[:, :3, 3] - truth[:, :3, 3]
    return METRES_FROM_WORLD.scale * float(np.sqrt((apart**2).sum(1).mean()))


@pytest.mark.parametrize("seed", [1, 2])
@pytest.mark.parametrize("stated", [True, False], ids=["stated", "measured"])
def test_a_flight_that_an_unknown_lens_bends_is_straightened_by_positions(seed, stated):
    rng = np.random.default_rng(seed)
    truth, tracks = flight(rng)
    bent = adjusted(truth, tracks, lenses=None).world_from_cam
    assert errors_m(bent, truth) > 0.4
    found = adjusted(bent, tracks, measured(truth, rng, 0.02, 0.02 if stated else np.nan))
    assert errors_m(found.world_from_cam, truth) < 0.05
    assert found.lenses.correction[0, 1] == pytest.approx(-0.03, abs=0.004)
    measured_again = Evidence(GUESS, positions=measured(truth, rng, 0.02, 0.02))
    rigs = [(Cameras.of(poses), measured_again) for poses in (bent, found.world_from_cam)]
    assert measured_misfits(rigs)["positions"][1].tolist() == [False, True]


def test_an_accuracy_that_residuals_contradict_is_not_believed():
    rng = np.random.default_rng(3)
    truth, tracks = flight(rng)
    alone = errors_m(adjusted(truth, tracks).world_from_cam, truth)
    wrong = measured(truth, rng, 5.0, 0.01)
    term = PositionTerm(wrong, Cameras.of(truth))
    assert term.noise == pytest.approx(500, rel=0.3)
    assert errors_m(adjusted(truth, tracks, wrong).world_from_cam, truth) < alone + 0.05


def test_wrong_positions_among_good_ones_have_no_say():
    rng = np.random.default_rng(4)
    truth, tracks = flight(rng)
    positions = measured(truth, rng, 0.02, 0.02)
    positions.metres[[2, 17]] += [[30.0, 0, 0], [0, 4, 9]]
    assert errors_m(adjusted(truth, tracks, positions).world_from_cam, truth) < 0.05


def test_coarse_positions_do_no_harm_and_leave_the_frame():
    rng = np.random.default_rng(5)
    truth, tracks = flight(rng)
    alone = adjusted(truth, tracks).world_from_cam
    coarse = measured(truth, rng, 3.0, np.nan)
    found = adjusted(truth, tracks, coarse).world_from_cam
    assert errors_m(found, truth) < errors_m(alone, truth) + 0.03
    rigs = [(Cameras.of(poses), Evidence(GUESS, positions=coarse)) for poses in (alone, found)]
    assert measured_misfits(rigs)["positions"][1].all()


def test_the_normal_equations_are_the_slopes_of_the_cost():
    rng = np.random.default_rng(6)
    truth, _ = flight(rng)
    cameras = Cameras.of(truth)
    term = PositionTerm(measured(truth, rng, 0.1, 0.05), cameras)
    right = term.linearise(cameras, 0.0).right
    step = 1e-5
    for unknown in (3, 10, 6 * 7 + 5):
        motion = np.zeros(cameras.unknowns)
        motion[unknown] = step
        ahead, back = (term.cost(cameras.moved(sign * motion), term.unknowns) for sign in (1, -1))
        assert (ahead - back) / (4 * step) == pytest.approx(right[unknown], rel=1e-4)


def land_errors_m(found, land):
    """Root mean square distance of points on the land from where they are, after alignment, m."""
    lenses = FREE if found.lenses is None else FREE.known(found.lenses.correction)
    cameras = Cameras.of(found.world_from_cam, lenses)
    term = TrackTerm(land.tracks, GUESS, cameras, 0.5)
    term.settle(cameras)
    apart = align_points(term.unknowns, land.metres).apply(term.unknowns) - land.metres
    return float(np.sqrt((apart**2).sum(1).mean()))


@pytest.mark.parametrize("seed", [1, 2])
def test_control_points_straighten_what_cameras_see_and_a_wrong_one_has_no_say(seed):
    rng = np.random.default_rng(seed)
    truth, tracks = flight(rng)
    tracks = tracks.where(tracks.point < 60)
    control, others = marked(truth, rng, 0.02, 12), marked(truth, rng, 0.0, 30, 0.0)
    control.metres[3] += [5.0, 0, 0]
    bent = adjusted(truth, tracks, lenses=None)
    free = adjusted(bent.world_from_cam, tracks)
    found = adjusted(bent.world_from_cam, tracks, control=control)
    assert land_errors_m(bent, others) > 0.5
    assert land_errors_m(found, others) < min(0.08, 0.4 * land_errors_m(free, others))
    lenses = FREE.known(found.lenses.correction)
    rigs = [Cameras.of(bent.world_from_cam), Cameras.of(found.world_from_cam, lenses)]
    misfits = measured_misfits([(rig, Evidence(GUESS, control=control)) for rig in rigs])
    assert misfits["control"][1].tolist() == [False, True]


def test_points_that_are_known_before_are_part_of_the_normal_equations():
    rng = np.random.default_rng(6)
    truth, _ = flight(rng)
    cameras = Cameras.of(truth)
    term = ControlTerm(marked(truth, rng, 0.05), GUESS, cameras)
    term.measure(cameras)

    def least(motion):
        moved = cameras.moved(motion)
        term.settle(moved)
        return term.cost(moved, term.unknowns)

    right, step = term.linearise(cameras, 0.0).right, 1e-6
    for unknown in (3, 6 * 7 + 1, 6 * 13 + 5):
        motion = np.zeros(cameras.unknowns)
        motion[unknown] = step
        assert (least(motion) - least(-motion)) / (4 * step) == pytest.approx(right[unknown], rel=1e-3)
