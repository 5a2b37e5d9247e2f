"""Parts are joined by the photos that they share; what does not fit stays out and is named; seams are measured."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from biresnerf.data.parts.join_parts import (
    APART,
    FEW,
    NOTHING,
    PartResult,
    join,
    joined_tracks,
    points_in_common,
)
from biresnerf.data.points.tracks import Tracks
from biresnerf.data.seeding.map_images import PARTS, MappedModel
from biresnerf.geometry.camera.camera_models import Camera
from biresnerf.geometry.pose_error import camera_errors
from biresnerf.geometry.rigid import rotation_of
from biresnerf.geometry.similarity import Similarity, align_by_spread

COUNT = 40
LENS = Camera("PINHOLE", 20, 16, (18.0, 18.0, 10.0, 8.0))


@pytest.fixture(scope="module")
def truth() -> NDArray[np.float64]:
    """World_from_cam of cameras around a point, each looking at it."""
    angles = np.linspace(0, 2 * np.pi, COUNT, endpoint=False)
    poses = np.tile(np.eye(4), (COUNT, 1, 1))
    poses[:, :3, :3] = Rotation.from_rotvec(angles[:, None] * [0.0, 1, 0]).as_matrix()
    poses[:, :3, 3] = -4 * poses[:, :3, 2] + np.random.default_rng(2).normal(0, 0.2, (COUNT, 3))
    return poses


def part(
    name: str, rows: NDArray[np.int64], poses: NDArray[np.float64], bound: float = np.nan, tracks: bool = True
) -> PartResult:
    model = MappedModel(PARTS, rows, poses, {0: LENS}, 100, 500, 0.4)
    points = np.repeat(np.arange(5), 2)
    found = Tracks.of(points, np.tile(rows[:2], 5), np.arange(20.0).reshape(10, 2)) if tracks else None
    return PartResult(name, model, np.full((len(rows), 2), bound), found)


def in_own_frame(poses: NDArray[np.float64], seed: int) -> NDArray[np.float64]:
    rng = np.random.default_rng(seed)
    turn = Rotation.random(random_state=seed).as_matrix()
    return np.asarray(Similarity(float(rng.uniform(0.5, 2)), turn, rng.normal(0, 5, 3)).apply_to_poses(poses))


def test_parts_in_frames_of_their_own_become_one_rig(truth: NDArray[np.float64]) -> None:
    rows = [np.arange(0, 18), np.arange(12, 30), np.arange(24, COUNT)]
    parts = [part(f"part-{k}", some, in_own_frame(truth[some], k)) for k, some in enumerate(rows)]
    model, report = join(COUNT, parts)
    np.testing.assert_array_equal(model.rows, np.arange(COUNT))
    errors = camera_errors(
        align_by_spread(model.world_from_cam, truth).apply_to_poses(model.world_from_cam), truth
    )
    assert errors.rotation_deg.max() < 1e-6
    assert errors.centre.max() < 1e-7
    assert [one.why_not for one in report.parts] == [None] * 3
    assert report.photos_left_out == 0
    assert {seam.parts: seam.photos for seam in report.seams} == {
        ("part-0", "part-1"): 6,
        ("part-1", "part-2"): 6,
    }
    assert report.part_of[:12] == (report.part_of[0],) * 12
    assert {report.part_of[0], report.part_of[20], report.part_of[39]} == {0, 1, 2}
    shared = {*range(12, 18), *range(24, 30)}
    assert {row for row, apart in enumerate(report.apart_deg) if apart is not None} == shared


def test_a_part_that_contradicts_the_others_or_shares_too_little_stays_out(
    truth: NDArray[np.float64],
) -> None:
    scattered = truth[12:24].copy()
    scattered[:, :3, :3] = Rotation.random(12, random_state=1).as_matrix()
    parts = [
        part("good", np.arange(0, 20), truth[:20]),
        part("wrong", np.arange(12, 24), scattered),
        part("far", np.arange(18, 30), truth[18:30]),
        part("empty", np.arange(0, 10), truth[:10], tracks=False),
    ]
    model, report = join(COUNT, parts)
    assert {one.name: one.why_not for one in report.parts} == {
        "good": None, "wrong": APART, "far": FEW, "empty": NOTHING,
    }  # fmt: skip
    np.testing.assert_array_equal(model.rows, np.arange(20))
    assert report.photos_left_out == 20
    assert report.part_of == (0,) * 20 + (None,) * 20
    assert len(report.doubts()) == 4
    assert "far" in report.doubts()[1]


def test_parts_of_one_name_keep_their_own_reasons(truth: NDArray[np.float64]) -> None:
    parts = [part("out", np.arange(20), truth[:20]), part("out", np.arange(19, 30), truth[19:30])]
    _, report = join(COUNT, parts)
    assert [one.why_not for one in report.parts] == [None, FEW]


def test_of_a_shared_photo_the_pose_with_the_smaller_bound_is_taken(truth: NDArray[np.float64]) -> None:
    rough = truth[:24].copy()
    rough[:, :3, :3] = rotation_of(np.random.default_rng(0).normal(0, 0.01, (24, 3))) @ rough[:, :3, :3]
    parts = [part("rough", np.arange(24), rough, 0.02), part("fine", np.arange(12, 30), truth[12:30], 0.001)]
    model, report = join(COUNT, parts)
    assert report.part_of == (0,) * 12 + (1,) * 18 + (None,) * 10
    found = model.world_from_cam[:, :3, :3]
    relative = np.swapaxes(found[12:29], 1, 2) @ found[13:30]
    expected = np.swapaxes(truth[12:29, :3, :3], 1, 2) @ truth[13:30, :3, :3]
    np.testing.assert_allclose(relative, expected, atol=1e-9)


def test_each_photo_says_whose_pose_it_has_and_by_how_much_parts_disagree_at_most(
    truth: NDArray[np.float64],
) -> None:
    turned = truth[12:30].copy()
    turned[0, :3, :3] = rotation_of(np.array([0.05, 0, 0])) @ turned[0, :3, :3]
    parts = [
        part("fine", np.arange(24), truth[:24], 0.001),
        part("rough", np.arange(12, 30), turned, 0.02),
        part("last", np.arange(10, 22), truth[10:22], 0.03),
    ]
    _, report = join(COUNT, parts)
    assert report.part_of == (0,) * 24 + (1,) * 6 + (None,) * 10
    assert report.apart_deg[12] == pytest.approx(np.degrees(0.05), rel=0.02)
    assert max(report.apart_deg[row] or 0 for row in range(COUNT) if row != 12) < 0.2
    fine, rough, last = parts  # the pair that comes last agrees
    assert join(COUNT, [rough, fine, last])[1].apart_deg[12] == pytest.approx(np.degrees(0.05), rel=0.02)


def test_seams_measure_the_noise_of_parts_and_hold_where_bounds_are_honest(
    truth: NDArray[np.float64],
) -> None:
    rng, noise = np.random.default_rng(3), 0.002
    # The length of three normal deviates is below 2.5 of them nine times in ten.
    bound = 2.5 * noise

    def noisy() -> NDArray[np.float64]:
        poses = truth.copy()
        poses[:, :3, :3] = rotation_of(rng.normal(0, noise, (COUNT, 3))) @ poses[:, :3, :3]
        poses[:, :3, 3] += rng.normal(0, noise, (COUNT, 3))
        return poses

    everything = np.arange(COUNT)
    shares = []
    for _ in range(10):
        _, report = join(
            COUNT, [part("a", everything, noisy(), bound), part("b", everything, noisy(), bound)]
        )
        (seam,) = report.seams
        # The median length of three deviates of sqrt(2) times the noise: 1.538 of them.
        assert seam.rotation_deg == pytest.approx(np.degrees(1.538 * np.sqrt(2) * noise), rel=0.35)
        assert seam.position == pytest.approx(1.538 * np.sqrt(2) * noise, rel=0.35)
        assert max(apart or 0 for apart in report.apart_deg) == pytest.approx(seam.rotation_deg_worst)
        assert seam.within is not None
        shares.append(seam.within)
    assert 0.8 < np.mean(shares) < 0.98


def test_parts_that_disagree_by_more_than_they_state_are_doubted(truth: NDArray[np.float64]) -> None:
    rows, bent = np.arange(COUNT), truth.copy()
    bent[:, :3, :3] = rotation_of(np.random.default_rng(4).normal(0, 0.005, (COUNT, 3))) @ bent[:, :3, :3]
    for bound, doubted in ((0.001, 1), (0.02, 0)):
        _, report = join(COUNT, [part("a", rows, truth, bound), part("b", rows, bent, bound)])
        assert len(report.doubts()) == doubted


def test_points_that_share_a_feature_of_a_photo_are_one_point() -> None:
    a = Tracks.of(
        np.array([0, 0, 1, 1]), np.array([0, 1, 0, 1]), np.array([[1.0, 1], [2, 2], [5, 5], [6, 6]])
    )
    b = Tracks.of(
        np.array([0, 0, 1, 1]), np.array([1, 2, 1, 2]), np.array([[2.0, 2], [3, 3], [8, 8], [9, 9]])
    )
    joined = joined_tracks([a, None, b], 3)
    assert joined is not None
    seen = {
        tuple(
            zip(
                joined.image[joined.point == k].tolist(),
                joined.xy[joined.point == k, 0].tolist(),
                strict=True,
            )
        )
        for k in range(joined.points)
    }
    assert seen == {((0, 1.0), (1, 2.0), (2, 3.0)), ((0, 5.0), (1, 6.0)), ((1, 8.0), (2, 9.0))}
    assert joined_tracks([None], 3) is None


@pytest.mark.parametrize("seed", [1, 2])
def test_photos_are_matched_by_the_points_that_both_see(seed: int) -> None:
    rng = np.random.default_rng(seed)
    seen = [rng.choice(9, int(rng.integers(2, 7)), replace=False) for _ in range(40)]
    point, image = np.repeat(np.arange(40), [len(each) for each in seen]), np.concatenate(seen)
    both = np.zeros((9, 9), np.int64)
    for each in seen:
        both[np.ix_(each, each)] += 1
    expected = [(a, b, int(both[a, b])) for a in range(9) for b in range(a + 1, 9) if both[a, b]]
    assert points_in_common(Tracks.of(point, image, rng.normal(size=(len(point), 2)))) == expected


def test_photos_without_points_match_nothing() -> None:
    assert points_in_common(None) == []
