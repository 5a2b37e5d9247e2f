"""The choice between sets of poses: by evidence to which they were not fitted; the first wins a tie."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.stats import ttest_1samp

from biresnerf.refinement.adjustment.choice import Candidate, choose, judged
from biresnerf.report import CandidateName

CAMERAS = 12
NAMES: tuple[CandidateName, ...] = ("input", "refined", "adjusted", "matched")


def chosen(**kinds: tuple[float, ...]) -> str:
    """The name that is taken where the candidates' errors on each kind of evidence are these, give or take 5 %."""
    rng = np.random.default_rng(0)
    misfits = {
        kind: np.array(errors)[:, None] ** 2 * np.exp(rng.normal(0, 0.05, (len(errors), CAMERAS)))
        for kind, errors in kinds.items()
    }
    count = len(next(iter(kinds.values())))
    found = choose([Candidate(name, np.zeros((CAMERAS, 4, 4))) for name in NAMES[:count]], misfits)
    assert [report.chosen for report in found.reports].count(True) == 1
    assert found.chosen.name == next(report.name for report in found.reports if report.chosen)
    return found.chosen.name


def test_the_best_fit_to_what_was_left_out_is_taken():
    assert chosen(tracks=(3.0, 1.6, 1.0, 1.2)) == "adjusted"
    assert chosen(tracks=(3.0, 1.6, 1.2, 1.0)) == "matched"


def test_on_a_tie_the_earlier_is_kept():
    """COLMAP's model of small photos fits tracks as well as poses that are four times as exact."""
    assert chosen(tracks=(3.0, 1.0, 1.0, 1.0)) == "refined"
    assert chosen(tracks=(3.0, 1.3, 1.0, 1.0)) == "adjusted"


def test_the_input_is_kept_on_a_tie_and_where_all_else_is_worse():
    assert chosen(tracks=(1.0, 1.0, 1.0, 1.0)) == "input"
    assert chosen(tracks=(1.0, 2.0, 1.05, 1.1), patches=(1.0, 1.1, 1.05, 1.3)) == "input"


def test_nothing_is_taken_that_one_kind_of_evidence_speaks_against():
    """Adjusted to tracks alone, a rig may fit them better and the photos worse."""
    assert chosen(tracks=(1.0, 1.0, 0.7, 1.0), patches=(1.0, 1.0, 2.0, 1.0)) == "input"
    assert chosen(tracks=(2.5, 1.0, 0.9, 2.5), patches=(2.5, 1.0, 1.6, 2.5)) == "refined"


def test_evidence_does_not_choose_between_candidates_that_are_alike_to_it():
    rng = np.random.default_rng(0)
    poses = [Candidate(name, np.zeros((CAMERAS, 4, 4))) for name in NAMES]

    def taken(alike, **kinds):
        misfits = {
            kind: np.array(errors)[:, None] ** 2 * np.exp(rng.normal(0, 0.05, (4, CAMERAS)))
            for kind, errors in kinds.items()
        }
        return choose(poses, misfits, {"tracks": np.array(alike)}).chosen.name

    tracks = (3.0, 1.3, 1.0, 1.0)
    assert taken((False,) * 4, tracks=tracks) == "adjusted"
    assert taken((False, True, True, True), tracks=tracks) == "refined"
    assert taken((True, True, True, True), tracks=tracks) == "input"
    assert taken((False, True, True, True), tracks=tracks, patches=(3.0, 1.3, 1.0, 1.3)) == "adjusted"


def test_another_candidate_may_be_the_one_that_is_kept_on_a_tie():
    poses = [Candidate(name, np.zeros((CAMERAS, 4, 4))) for name in NAMES[:3]]
    same = {"tracks": np.ones((3, CAMERAS))}
    assert choose(poses, same, first=1).chosen.name == "refined"
    better = {"tracks": np.array([[0.5], [1.0], [2.0]]) * np.ones((3, CAMERAS))}
    assert choose(poses, better, first=1).chosen.name == "input"


def test_evidence_that_knows_no_camera_says_nothing():
    poses = [Candidate(name, np.zeros((CAMERAS, 4, 4))) for name in NAMES[:2]]
    none = choose(poses, {"tracks": np.full((2, CAMERAS), np.nan)})
    assert (none.chosen.name, none.reports[0].track_misfit) == ("input", None)
    assert choose(poses, {}).chosen.name == "input"
    few = np.full((2, CAMERAS), np.nan)
    few[:, :2] = [[5.0, 5.0], [1.0, 1.0]]
    assert choose(poses, {"tracks": few}).chosen.name == "input"


@pytest.mark.parametrize("seed", range(3))
def test_chance_chooses_other_poses_rarely(seed):
    rng = np.random.default_rng(seed)
    poses = [Candidate(name, np.zeros((CAMERAS, 4, 4))) for name in NAMES[:2]]
    moved = sum(
        choose(poses, {"tracks": np.exp(rng.normal(0, 0.1, (2, CAMERAS)))}).chosen.name != "input"
        for _ in range(400)
    )
    assert moved < 0.05 * 400


@pytest.mark.parametrize("cameras", [3, 4, 5, 6])
def test_beyond_chance_is_as_in_students_test(cameras):
    rng = np.random.default_rng(cameras)
    gains = rng.normal(0, 0.3, (400, cameras)) + rng.uniform(0, 1, (400, 1))
    found = np.array([judged(np.ones(cameras), 2.0 ** (-2 * each)) == "better" for each in gains])
    tested = ttest_1samp(gains, 0, axis=1)
    clear = abs(tested.pvalue - 0.05) > 1e-3
    assert 0.1 < found.mean() < 0.9
    np.testing.assert_array_equal(found[clear], ((tested.pvalue < 0.05) & (tested.statistic > 0))[clear])
