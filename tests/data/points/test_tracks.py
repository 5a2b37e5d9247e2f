"""Tracks: one point's features in all photos that show it; kept whole by thinning, restored after a break."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from biresnerf.data.points.tracks import KEPT, Tracks, keep_tracks


def seen_points(
    rng: np.random.Generator, points: int, photos: int, seen_by: int
) -> tuple[np.ndarray, np.ndarray]:
    """Every point lies at a place of its own in each of some photos: matches [m, 2] and [m, 2, 2] of all pairs."""
    images, xy = [], []
    for _ in range(points):
        who, where = rng.choice(photos, seen_by, replace=False), rng.uniform(0, 600, (photos, 2))
        for i, a in enumerate(who):
            for b in who[i + 1 :]:
                images.append((a, b))
                xy.append((where[a], where[b]))
    return np.array(images), np.array(xy)


def same(one: Tracks, other: Tracks) -> bool:
    return all(np.array_equal(getattr(one, name), getattr(other, name)) for name in ("point", "image", "xy"))


def test_matches_of_all_pairs_make_one_track_of_each_point():
    images, xy = seen_points(np.random.default_rng(0), points=40, photos=9, seen_by=5)
    tracks = Tracks.of_matches(images, xy)
    assert (tracks.points, len(tracks), set(tracks.lengths)) == (40, 200, {5})
    assert (np.diff(tracks.point) >= 0).all()
    assert all((np.diff(tracks.image[tracks.point == k]) > 0).all() for k in range(40))


def test_the_order_of_matches_changes_nothing():
    rng = np.random.default_rng(1)
    images, xy = seen_points(rng, points=40, photos=9, seen_by=4)
    order = rng.permutation(len(images))
    assert same(Tracks.of_matches(images, xy), Tracks.of_matches(images[order], xy[order]))


def test_one_wrong_match_does_not_join_two_points_that_a_photo_tells_apart():
    images = np.array([[0, 1], [1, 2], [0, 2], [0, 1], [1, 2], [0, 2], [0, 1]])
    one, other = np.array([[10, 10], [11, 11], [12, 12]]), np.array([[50, 50], [51, 51], [52, 52]])
    xy = np.array([p[[a, b]] for p, (a, b) in zip([one] * 3 + [other] * 3, images[:6], strict=True)])
    wrong = np.array([[one[0], other[1]]])
    tracks = Tracks.of_matches(images, np.concatenate([xy, wrong]))
    assert tracks.points == 2
    np.testing.assert_array_equal(tracks.xy[tracks.point == 0], one)
    np.testing.assert_array_equal(tracks.xy[tracks.point == 1], other)


@pytest.mark.parametrize("seed", range(3))
def test_most_points_stay_whole_with_every_tenth_match_wrong(seed):
    rng = np.random.default_rng(seed)
    images, xy = seen_points(rng, points=150, photos=8, seen_by=5)
    true = Tracks.of_matches(images, xy)
    wrong = rng.random(len(images)) < 0.1
    for i in np.flatnonzero(wrong):  # to another feature of the same photo
        xy[i, 1] = true.xy[rng.choice(np.flatnonzero(true.image == images[i, 1]))]
    found = Tracks.of_matches(images, xy)
    whole = {tuple(map(tuple, true.xy[true.point == k])) for k in range(true.points)}
    again = {tuple(map(tuple, found.xy[found.point == k])) for k in range(found.points)}
    assert len(whole & again) > 0.9 * len(whole)
    assert all(len(set(found.image[found.point == k])) == length for k, length in enumerate(found.lengths))


def test_a_fixed_share_of_points_is_left_out_whole_and_the_rest_are_all_there():
    tracks = Tracks.of_matches(*seen_points(np.random.default_rng(2), points=2000, photos=9, seen_by=3))
    fitted, left_out = tracks.split(0.2, seed=3)
    assert fitted.points + left_out.points == tracks.points
    assert len(fitted) + len(left_out) == len(tracks)
    assert 0.17 < left_out.points / tracks.points < 0.23
    assert same(tracks.split(0.2, seed=3)[1], left_out)
    assert not same(tracks.split(0.2, seed=4)[1], left_out)
    assert (tracks.left_out(0.2, seed=3) <= tracks.left_out(0.4, seed=3)).all()
    assert tracks.split(0.0)[1] is None


def test_thinning_keeps_points_whole_and_every_photo_in_play():
    rng = np.random.default_rng(4)
    dense, sparse = seen_points(rng, 600, 6, 4), seen_points(rng, 40, 2, 2)
    images, xy = np.concatenate([dense[0], sparse[0] + 6]), np.concatenate([dense[1], sparse[1]])
    tracks = Tracks.of_matches(images, xy)
    thin = tracks.thinned(800, 8)
    assert len(thin) <= 800
    assert set(thin.lengths) == {2, 4}
    assert np.bincount(thin.image).min() >= 35
    assert tracks.thinned(10_000, 8) is tracks


def test_pairs_go_round_each_track_once():
    tracks = Tracks.of(np.array([0, 0, 1, 1, 1]), np.array([2, 4, 0, 1, 5]), np.zeros((5, 2)))
    a, b = tracks.pairs()
    assert list(zip(a.tolist(), b.tolist(), strict=True)) == [(0, 1), (2, 3), (3, 4), (4, 2)]


def test_what_is_kept_comes_back_by_name_and_nothing_of_nothing(tmp_path: Path):
    names = ("a.jpg", "b.jpg", "c.jpg")
    tracks = Tracks.of_matches(*seen_points(np.random.default_rng(5), points=20, photos=3, seen_by=3))
    np.savez(tmp_path / KEPT, **tracks.kept())
    keep_tracks(tmp_path, names, tmp_path / "kept" / KEPT)
    assert same(Tracks.load(tmp_path / "kept" / KEPT, names), tracks)
    turned = Tracks.load(tmp_path / "kept" / KEPT, names[::-1])
    assert (turned.points, len(turned)) == (20, 60)
    np.testing.assert_array_equal(turned.xy[turned.image == 0], tracks.xy[tracks.image == 2])
    fewer = Tracks.load(tmp_path / "kept" / KEPT, names[:2])
    assert set(fewer.lengths) == {2}
    assert Tracks.load(tmp_path / "nowhere", names) is None
    assert Tracks.of_matches(np.zeros((0, 2)), np.zeros((0, 2, 2))) is None
