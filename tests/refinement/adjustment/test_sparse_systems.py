"""Cameras with local views: elimination front by front gives the same as one dense matrix."""

import os
import subprocess
import sys
from dataclasses import replace

import numpy as np
import pytest

from benchmarks.large.camera_rigs import rig
from benchmarks.large.many_cameras import ONE_THREAD
from biresnerf.geometry.rigid_bodies import RigidBodies
from biresnerf.refinement.adjustment.adjustment import adjust_poses, patch_term
from biresnerf.refinement.adjustment.cameras import Cameras
from biresnerf.refinement.adjustment.evidence import Patches, PosePrior, Positions
from biresnerf.refinement.adjustment.lens.lenses import Lenses
from biresnerf.refinement.adjustment.solver import covariance as covariances
from biresnerf.refinement.adjustment.solver import dissection
from biresnerf.refinement.adjustment.solver.blocks import Blocks
from biresnerf.refinement.adjustment.solver.body_motions import BodyMoves
from biresnerf.refinement.adjustment.solver.elimination import inverse_blocks, solution
from biresnerf.refinement.adjustment.track_term import TrackTerm
from biresnerf.refinement.finish.expected_errors import expected_errors
from tests.refinement.adjustment.test_patch_adjustment import Plane

CAMERAS = 40
NUMBERS = np.arange(CAMERAS)
LENS = np.array([0.02, 0.1, 0.1, 0.01, 0.01, 0.0, 0.0, 0.0])  # deviations; the last three are held
FOCAL_ALONE = np.arange(8) == 0
NONE = np.zeros(CAMERAS, np.bool_)
LENSES = {
    "a lens that all share": Lenses(0 * NUMBERS, np.zeros((1, 8)), LENS[None]),
    "three lenses": Lenses(NUMBERS % 3, np.zeros((3, 8)), np.tile(LENS, (3, 1))),
    "a lens of each camera": Lenses(
        NUMBERS, np.zeros((CAMERAS, 8)), np.tile(LENS * FOCAL_ALONE, (CAMERAS, 1))
    ),
}
BODIES = {
    "rigs": RigidBodies(NUMBERS // 2, NONE),
    "rigs far apart": RigidBodies(NUMBERS % (CAMERAS // 2), NONE),
    "fixed cameras": RigidBodies(NUMBERS, NUMBERS % 13 == 5),
    "a fixed rig": RigidBodies(NUMBERS // 2, NUMBERS // 2 == 7),
}


@pytest.fixture(name="fronts")
def small_fronts(monkeypatch):
    """Switches between one front and many."""

    def switch(many):
        monkeypatch.setattr(dissection, "ONE_FRONT", 0 if many else 10**6)
        monkeypatch.setattr(dissection, "LEAF", 3)
        monkeypatch.setattr(dissection, "TIED_TO_MANY", 0.6)
        dissection._fronts.cache_clear()

    yield switch
    dissection._fronts.cache_clear()


def fronts_of(system):
    return dissection.fronts_of(system.begin, system.other)


def linearised(given):
    cameras = Cameras.of(given.truth, given.evidence.lenses)
    term = TrackTerm(given.evidence.tracks, given.evidence.intrinsics, cameras, 0.5)
    term.settle(cameras)
    return cameras, term.linearise(cameras, 0.0)


def in_both_ways(fronts, evidence, start, prior):
    """Adjusted, with the expected errors, in one front and in many."""
    found = []
    for many in (False, True):
        fronts(many)
        result = adjust_poses(start, evidence, prior)
        lenses = evidence.lenses and replace(evidence.lenses, correction=result.lenses.correction)
        held = replace(evidence, lenses=lenses)
        errors = expected_errors(result.world_from_cam, result.world_from_cam, held, bodies=prior.bodies)
        found.append((result, errors.covariance))
    return found


# Of rigs' nearly dependent unknowns: the order of sums, which depends on the machine, changed up to 1.3e-6.
OF_RIGS = 1e-5


def assert_same(one, many, tolerance=1e-6):
    (dense, certain), (sparse, found) = one, many
    np.testing.assert_allclose(sparse.world_from_cam, dense.world_from_cam, atol=1e-8)
    assert sparse.track_noise_px == pytest.approx(dense.track_noise_px, rel=1e-8, nan_ok=True)
    deviation = np.sqrt(np.maximum(np.diagonal(certain, axis1=1, axis2=2), 1e-20))
    scale = deviation[:, :, None] * deviation[:, None, :]
    assert np.isfinite(certain).all()
    np.testing.assert_allclose(found / scale, certain / scale, atol=tolerance)
    if dense.lenses is not None:
        np.testing.assert_allclose(sparse.lenses.correction, dense.lenses.correction, atol=1e-8)
        np.testing.assert_allclose(sparse.lenses.deviation, dense.lenses.deviation, rtol=1e-4)
        np.testing.assert_array_equal(sparse.lenses.observable, dense.lenses.observable)


def test_fronts_solve_what_the_dense_matrix_solves(fronts):
    given = rig("corridor", CAMERAS)
    _, linear = linearised(replace(given, evidence=replace(given.evidence, lenses=LENSES["three lenses"])))
    system = linear.system.with_diagonal(np.ones(len(linear.right)))
    free = np.arange(len(linear.right)) % 7 != 0
    expected = np.zeros(len(free))
    expected[free] = np.linalg.solve(system.dense()[np.ix_(free, free)], linear.right[free])
    fronts(True)
    assert len(fronts_of(system)) > 8
    np.testing.assert_allclose(solution(system, linear.right, free), expected, rtol=1e-8, atol=1e-12)


@pytest.mark.parametrize("shape", ["ring", "aerial"])
def test_uncertainties_of_300_cameras_are_those_of_the_dense_inverse(shape):
    cameras, linear = linearised(rig(shape, 300))
    assert len(fronts_of(linear.system)) > 8
    common = covariances.common_motions(cameras, np.ones(300, np.bool_))
    held = 1e6 * covariances.seen_aligning(common, np.ones(300, np.bool_))
    system = linear.system.with_diagonal(np.ones(1800))
    dense = np.linalg.inv(np.block([[system.dense(), held], [held.T, np.zeros((7, 7))]]))[:1800, :1800]
    dense = dense.reshape(300, 6, 300, 6)[np.arange(300), :, np.arange(300)]
    found = inverse_blocks(system, np.ones(1800, np.bool_), held)
    np.testing.assert_allclose(
        np.linalg.norm(found - dense, axis=(1, 2)) / np.linalg.norm(dense, axis=(1, 2)), 0, atol=1e-6
    )


def test_thousands_of_cameras_that_share_nothing_are_eliminated_in_few_fronts():
    """Photos without matches are groups of their own."""
    alone = Blocks.nothing(Cameras.of(np.tile(np.eye(4), (5000, 1, 1))))
    system = alone.with_diagonal(np.arange(1.0, 30_001))
    assert len(fronts_of(system)) < 5000 / dissection.LEAF + 2
    found = solution(system, np.ones(30_000), np.ones(30_000, np.bool_))
    np.testing.assert_allclose(found, 1 / np.arange(1.0, 30_001))


IN_ITS_OWN_PROCESS = """
import ctypes, re, sys
from pathlib import Path
from benchmarks.large.camera_rigs import rig
from biresnerf.refinement.adjustment import adjustment
from biresnerf.refinement.finish.expected_errors import expected_errors

def peak():
    return 1024 * int(re.search(r"VmHWM:\\s*(\\d+) kB", Path("/proc/self/status").read_text())[1])

small = rig("ring", 12)
poses = adjustment.adjust_poses(small.given, small.evidence, small.prior).world_from_cam
expected_errors(poses, poses, small.evidence)
given = rig(sys.argv[1], int(sys.argv[2]))
ctypes.CDLL(None).malloc_trim(0)  # what compiling took
Path("/proc/self/clear_refs").write_text("5")  # the peak is that from now on
before = peak()
poses = adjustment.adjust_poses(given.given, given.evidence, given.prior).world_from_cam
expected_errors(poses, poses, given.evidence)
print(peak() - before, adjustment.adjustment_bytes(given.evidence.tracks, len(poses)))
"""


def memory(shape, count):
    """Bytes that an adjustment took, and what was said before."""
    command = [sys.executable, "-c", IN_ITS_OWN_PROCESS, shape, str(count)]
    printed = subprocess.check_output(command, text=True, env=os.environ | ONE_THREAD)
    return map(int, printed.split())


@pytest.mark.skipif(sys.platform != "linux", reason="not Linux")
@pytest.mark.parametrize(("shape", "count"), [("aerial", 800), ("ring", 800)])
def test_an_adjustment_takes_about_as_much_memory_as_was_said_before(shape, count):
    memory(shape, 12)  # compiles, which takes much memory
    taken, said = memory(shape, count)
    assert 0.5 < said / taken < 2


def test_blocks_of_evidence_add_up(fronts):
    given = rig("aerial", CAMERAS)
    cameras, linear = linearised(given)
    own = np.tile(np.diag([0, 0, 0, 1.0, 2, 3]), (2, 1, 1))
    more = Blocks.of_cameras(cameras, np.array([3, 30]), own)
    expected = linear.system.dense()
    for camera in (3, 30):
        expected[6 * camera : 6 * camera + 6, 6 * camera : 6 * camera + 6] += own[0]
    for both in (linear.system + more, more + linear.system):
        np.testing.assert_array_equal(both.dense(), expected)


@pytest.mark.parametrize("bodies", BODIES.values(), ids=BODIES.keys())
def test_a_matrix_of_bodies_is_the_cameras_between_their_columns(bodies):
    given = rig("corridor", CAMERAS)
    given = replace(given, evidence=replace(given.evidence, lenses=LENSES["three lenses"]))
    cameras, linear = linearised(given)
    moves = BodyMoves.among(cameras, bodies)
    count = 6 * moves.bodies
    columns = np.zeros((len(linear.right), count + 24))
    columns[: 6 * CAMERAS, :count] = moves.of_cameras(np.eye(count).reshape(-1, 6, count)).reshape(-1, count)
    columns[6 * CAMERAS :, count:] = np.eye(24)
    expected = columns.T @ linear.system.dense() @ columns
    size = np.abs(expected).max()
    np.testing.assert_allclose(moves.reduced(linear.system).dense(), expected, atol=1e-12 * size)


@pytest.mark.parametrize("shape", ["ring", "corridor", "aerial"])
def test_cameras_end_where_the_dense_system_leads(fronts, shape):
    given = rig(shape, CAMERAS)
    assert_same(*in_both_ways(fronts, given.evidence, given.given, given.prior))


@pytest.mark.parametrize("lenses", LENSES.values(), ids=LENSES.keys())
def test_freed_lenses_end_where_the_dense_system_leads(fronts, lenses):
    given = rig("aerial", CAMERAS)
    evidence = replace(given.evidence, lenses=lenses)
    assert_same(*in_both_ways(fronts, evidence, given.given, given.prior))


@pytest.mark.parametrize("bodies", BODIES.values(), ids=BODIES.keys())
def test_rigs_and_fixed_cameras_end_where_the_dense_system_leads(fronts, bodies):
    given = rig("corridor", CAMERAS)
    prior = replace(given.prior, bodies=bodies)
    assert_same(*in_both_ways(fronts, given.evidence, given.truth, prior), OF_RIGS)


def test_rigs_with_freed_lenses_end_where_the_dense_system_leads(fronts):
    given = rig("corridor", CAMERAS)
    prior = replace(given.prior, bodies=BODIES["rigs"])
    evidence = replace(given.evidence, lenses=LENSES["three lenses"])
    assert_same(*in_both_ways(fronts, evidence, given.truth, prior), OF_RIGS)


def test_measured_positions_end_where_the_dense_system_leads(fronts):
    given, rng = rig("aerial", CAMERAS), np.random.default_rng(1)
    metres = 20 * given.truth[:, :3, 3] + rng.normal(0, 0.1, (CAMERAS, 3))
    positions = Positions.of(NUMBERS, metres, np.full((CAMERAS, 3), 0.1))
    evidence = replace(given.evidence, positions=positions)
    assert_same(*in_both_ways(fronts, evidence, given.given, given.prior))


@pytest.mark.slow
def test_patches_end_where_the_dense_system_leads(fronts):
    plane = Plane(np.random.default_rng(5), cameras=16)
    start = plane.truth.copy()
    start[:, :3, 3] += np.random.default_rng(2).normal(0, 0.01, (16, 3))
    evidence = plane.evidence(start)
    every = evidence.patches
    apart = (every.target - every.host[every.point]) % 16
    near = np.isin(apart, [1, 15])
    evidence = replace(
        evidence,
        patches=Patches(
            every.host, every.rays, every.inverse_depth, every.point[near], every.target[near], every.photos
        ),
    )
    fronts(True)
    cameras = Cameras.of(start)
    assert len(fronts_of(patch_term(cameras, evidence, 1.0).linearise(cameras, 0.0).system)) > 2
    one, many = in_both_ways(fronts, evidence, start, PosePrior.equal(start, 0.02, 0.06))
    assert many[0].halves.apart_deg == pytest.approx(one[0].halves.apart_deg, rel=1e-5)
    assert_same(one, many)
