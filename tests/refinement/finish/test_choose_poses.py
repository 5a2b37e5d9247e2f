"""Which poses a run returns where the evidence cannot tell its candidates apart."""

from __future__ import annotations

import numpy as np
import pytest

from biresnerf.data.seeding.initial_poses import InitialPoses
from biresnerf.refinement.adjustment.choice import Candidate
from biresnerf.refinement.finish.choose_poses import _kept_on_a_tie
from biresnerf.report import PoseSource, TrialReport

POSES = np.tile(np.eye(4), (4, 1, 1))
NAMES = ("input", "refined", "adjusted-tracks", "matched")
TOLD_APART = {"tracks": np.zeros(4, np.bool_)}
TRIALS = (
    TrialReport(source="given", placed=0, psnr=13.4),
    TrialReport(source="matches-incremental", placed=4, psnr=15.2),
)


def kept(source: PoseSource, trials: tuple[TrialReport, ...], alike=TOLD_APART) -> str:
    start = InitialPoses(POSES, source, (source,) * 4, trials, POSES)
    candidates = [Candidate(name, POSES) for name in NAMES]
    return NAMES[_kept_on_a_tie(candidates, {"tracks"}, alike, start)]


@pytest.mark.parametrize(
    ("source", "trials", "name"),
    [
        ("given", TRIALS, "input"),  # the trial was for them, or matches were no better
        ("matches-incremental", (), "input"),  # photos alone: the input's poses are those of matches
        ("matches-incremental", TRIALS, "matched"),
    ],
    ids=["given ones won", "photos alone", "matched ones won"],
)
def test_poses_that_lost_the_trial_by_photos_are_not_kept_on_a_tie(source, trials, name):
    assert kept(source, trials) == name


def test_refined_poses_are_kept_where_no_evidence_tells_them_from_the_inputs():
    assert kept("given", TRIALS, {"tracks": np.ones(4, np.bool_)}) == "refined"
