"""Similarities and the alignment of rigs, against formulas written out and known truth."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from biresnerf.geometry.similarity import Similarity, align_by_spread, align_robust
from tests.geometry.rigs import dome, jitter, look_at, similar

seeds = st.integers(0, 2**31)
scales = st.floats(1e-3, 1e3)


def draw(rng: np.random.Generator, scale: float) -> Similarity:
    return Similarity(scale, Rotation.random(rng=rng).as_matrix(), rng.normal(size=3) * 10)


def angle_deg(a: np.ndarray, b: np.ndarray) -> float:
    return float(np.degrees((Rotation.from_matrix(a) * Rotation.from_matrix(b).inv()).magnitude()))


def assert_same(one: Similarity, other: Similarity, tolerance: float = 1e-9) -> None:
    assert one.scale == pytest.approx(other.scale, rel=tolerance)
    assert angle_deg(one.rotation, other.rotation) < np.degrees(tolerance) + 1e-7
    np.testing.assert_allclose(one.translation, other.translation, atol=tolerance * 100 * max(1, one.scale))


@settings(deadline=None, max_examples=50)
@given(seeds, scales, scales)
def test_inverse_and_composition_are_a_group(seed, scale, other_scale):
    rng = np.random.default_rng(seed)
    c_from_b, b_from_a = draw(rng, scale), draw(rng, other_scale)
    x_in_a = rng.normal(size=(5, 3))
    c_from_a = c_from_b @ b_from_a
    np.testing.assert_allclose(
        c_from_a.apply(x_in_a), c_from_b.apply(b_from_a.apply(x_in_a)), rtol=1e-9, atol=1e-6
    )
    np.testing.assert_allclose(b_from_a.inverse().apply(b_from_a.apply(x_in_a)), x_in_a, atol=1e-9 * 1e3)
    assert_same(b_from_a @ b_from_a.inverse(), Similarity.identity(), 1e-9)


def test_a_pose_keeps_seeing_the_point_in_the_same_direction():
    rng = np.random.default_rng(3)
    b_from_a, pose = draw(rng, 2.5), look_at(rng.normal(size=3) * 4, np.zeros(3))
    x_in_a = rng.normal(size=3)
    moved = b_from_a.apply_to_poses(pose)
    before = pose[:3, :3].T @ (x_in_a - pose[:3, 3])
    after = moved[:3, :3].T @ (b_from_a.apply(x_in_a) - moved[:3, 3])
    np.testing.assert_allclose(after, 2.5 * before, atol=1e-12)
    np.testing.assert_allclose(moved[3], [0, 0, 0, 1])


def test_a_similarity_without_size_is_refused():
    for scale in (0.0, -1.0, float("nan"), float("inf")):
        with pytest.raises(ValueError, match="scale"):
            Similarity(scale, np.eye(3), np.zeros(3))


@settings(deadline=None, max_examples=60)
@given(seeds, scales, st.integers(1, 30), st.sampled_from(["solid", "flat", "line", "point"]))
@pytest.mark.parametrize("align", [align_by_spread, align_robust])
def test_a_known_similarity_is_recovered_whatever_the_rank_of_the_rig(align, seed, scale, cameras, shape):
    rng = np.random.default_rng(seed)
    rig = jitter(dome(cameras, rng), rng, 0.3, 0.3)
    kept = {"solid": 3, "flat": 2, "line": 1, "point": 0}[shape]
    rig[:, :3, 3] *= np.arange(3) < kept
    rig = similar(rig, 1.0, Rotation.random(rng=rng).as_matrix(), rng.normal(size=3))
    expected = draw(rng, 1.0 if kept == 0 or cameras == 1 else scale)
    found = align(rig, similar(rig, expected.scale, expected.rotation, expected.translation))
    assert_same(found, expected, 1e-7)


def test_a_noisy_solid_rig_gives_scipys_rotation_and_the_ratio_of_spreads():
    rng = np.random.default_rng(5)
    a = dome(40, rng)
    b = jitter(similar(a, 3.0, Rotation.random(rng=rng).as_matrix(), rng.normal(size=3)), rng, 0.1, 0.4)
    found = align_by_spread(a, b)
    x, y = a[:, :3, 3] - a[:, :3, 3].mean(0), b[:, :3, 3] - b[:, :3, 3].mean(0)
    expected, _ = Rotation.align_vectors(y, x)
    assert angle_deg(found.rotation, expected.as_matrix()) < 1e-6
    assert found.scale == pytest.approx(np.sqrt((y**2).sum() / (x**2).sum()))


@pytest.mark.parametrize("tilt_deg", [0, 20, 45, 90])
def test_a_flat_rig_is_aligned_by_a_rotation_never_a_reflection(tilt_deg):
    tilt = Rotation.from_euler("x", tilt_deg, degrees=True).as_matrix()
    for seed in range(20):
        rng = np.random.default_rng(seed)
        rig = dome(30, rng)
        rig[:, 2, 3] = 0.0
        truth = similar(rig, 1.0, tilt, np.zeros(3))
        found = align_by_spread(jitter(truth, rng, 0.01, 0.05), truth)
        assert np.linalg.det(found.rotation) == pytest.approx(1.0)
        assert angle_deg(found.rotation, np.eye(3)) < 1.5


def test_cameras_on_a_line_take_the_turn_about_it_from_their_rotations():
    rng = np.random.default_rng(8)
    centres = np.linspace(-2, 2, 9)[:, None] * np.array([1.0, 0.2, -0.1])
    truth = np.stack([look_at(c, np.array([0.0, 6.0, 0.5])) for c in centres])
    # A hundredth of a hundredth off the line: alone it would decide the turn at random.
    noisy = jitter(truth, rng, 0.005, 4e-4)
    turned = similar(
        noisy, 1.0, Rotation.from_euler("zyx", [40, 70, -20], degrees=True).as_matrix(), np.ones(3)
    )
    aligned = align_by_spread(turned, truth).apply_to_poses(turned)
    for one, other in zip(aligned, truth, strict=True):
        assert angle_deg(one[:3, :3], other[:3, :3]) < 2.0


@pytest.mark.parametrize("share", [0.1, 0.2, 0.3])
def test_outliers_drag_the_least_squares_alignment_but_not_the_robust_one(share):
    rng = np.random.default_rng(11)
    truth = dome(40, rng)
    estimate = jitter(truth, rng, 0.001, 0.004)
    lost = int(share * len(truth))
    estimate[:lost] = dome(lost, np.random.default_rng(99))
    estimate = similar(estimate, 0.5, Rotation.random(rng=rng).as_matrix(), rng.normal(size=3))

    def good_cameras(align):
        moved = align(estimate, truth).apply_to_poses(estimate)[lost:]
        return np.mean([angle_deg(a[:3, :3], b[:3, :3]) for a, b in zip(moved, truth[lost:], strict=True)])

    assert good_cameras(align_robust) < 0.15
    assert good_cameras(align_by_spread) > 1.0


def test_a_scale_that_is_known_stays_1_though_the_rigs_sizes_differ():
    rng = np.random.default_rng(12)
    rig = dome(20, rng)
    turn, shift = Rotation.random(rng=rng).as_matrix(), rng.normal(size=3)
    estimate = similar(jitter(rig, rng, 0.001, 0.004), 1.3, turn, shift)
    found = align_robust(estimate, rig, with_rotations=True, with_scale=False)
    assert found.scale == 1.0
    assert angle_deg(found.rotation, turn.T) < 0.15
    assert align_robust(estimate, rig).scale == pytest.approx(1 / 1.3, rel=0.01)


@pytest.mark.parametrize("align", [align_by_spread, align_robust])
def test_rigs_that_cannot_be_compared_are_refused(align):
    rig = dome(4, np.random.default_rng(0))
    with pytest.raises(ValueError, match="one shape"):
        align(rig, rig[:3])
    with pytest.raises(ValueError, match="one shape"):
        align(rig[:0], rig[:0])
    broken = rig.copy()
    broken[2, 0, 3] = np.nan
    with pytest.raises(ValueError, match="finite"):
        align(rig, broken)
