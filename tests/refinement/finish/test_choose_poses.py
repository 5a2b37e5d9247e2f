"""Which poses a run returns where the evidence cannot tell its candidates apart."""

from __future__ import annotations

import numpy as np
import pytest

from biresnerf.data.seeding.initial_poses import InitialPoses
from biresnerf.refinement.adjustment.choice import Candidate
from biresnerf.refinement.finish.choose_poses import _choice, _kept_on_a_tie
from biresnerf.report import TrialReport

POSES = np.tile(np.eye(4), (4, 1, 1))
NAMES = ("input", "refined", "adjusted-tracks", "matched")
TRIALS = (
    TrialReport(source="given", placed=0, psnr=13.4),
    TrialReport(source="matches-incremental", placed=4, psnr=15.2),
)


CANDIDATES = [Candidate(name, POSES) for name in NAMES]


# Misfits of input, refined, adjusted and matched poses to tracks of four cameras.
TIE = np.array([[6.0, 6.0, 2.0, 2.0], [6.0, 6.0, 2.0, 2.0], [1.0, 1.5, 1.9, 2.1], [1.1, 1.4, 2.0, 2.0]])
ADJUSTED_BEATS_INPUT = np.array([[8.0] * 4, [6.0, 2.0, 7.0, 3.0], [1.0, 1.1, 1.0, 1.1], [1.1, 1.0, 1.2, 1.1]])


@pytest.mark.parametrize(
    ("source", "trials", "misfit", "name"),
    [
        ("given", TRIALS, TIE, "input"),  # the trial was for them, or matches were no better
        ("matches-incremental", (), TIE, "input"),  # photos alone: the input's poses are those of matches
        ("matches-incremental", TRIALS, TIE, "matched"),
        ("matches-incremental", TRIALS, ADJUSTED_BEATS_INPUT, "adjusted-tracks"),
        ("given", TRIALS, ADJUSTED_BEATS_INPUT, "adjusted-tracks"),
    ],
    ids=["given won", "photos alone", "matches won", "adjusted", "adjusted, given won"],
)
def test_a_tie_gives_poses_that_lost_the_trial_by_photos_not_back(source, trials, misfit, name):
    start = InitialPoses(POSES, source, (source,) * 4, trials, POSES)
    assert _choice(CANDIDATES, {"tracks": misfit}, {}, start).chosen.name == name


def test_refined_poses_are_kept_where_no_evidence_tells_them_from_the_inputs():
    alike = {"tracks": np.ones(4, np.bool_)}
    assert NAMES[_kept_on_a_tie(CANDIDATES, {"tracks"}, alike)] == "refined"
    assert NAMES[_kept_on_a_tie(CANDIDATES, {"tracks"}, {"tracks": ~alike["tracks"]})] == "input"
