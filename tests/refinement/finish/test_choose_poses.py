"""Which poses a run returns where the evidence cannot tell its candidates apart."""

from __future__ import annotations

import numpy as np
import pytest

from biresnerf.data.seeding.initial_poses import InitialPoses
from biresnerf.refinement.adjustment.choice import Candidate
from biresnerf.refinement.finish.choose_poses import _kept_on_a_tie, _that_won_the_trial
from biresnerf.report import TrialReport

POSES = np.tile(np.eye(4), (4, 1, 1))
NAMES = ("input", "refined", "adjusted-tracks", "matched")
TRIALS = (
    TrialReport(source="given", placed=0, psnr=13.4),
    TrialReport(source="matches-incremental", placed=4, psnr=15.2),
)


CANDIDATES = [Candidate(name, POSES) for name in NAMES]


@pytest.mark.parametrize(
    ("source", "trials", "name"),
    [
        ("given", TRIALS, None),  # the trial was for them, or matches were no better
        ("matches-incremental", (), None),  # photos alone: the input's poses are those of matches
        ("matches-incremental", TRIALS, "matched"),
    ],
    ids=["given ones won", "photos alone", "matched ones won"],
)
def test_poses_of_matches_that_won_the_trial_by_photos_take_the_inputs_place_on_a_tie(source, trials, name):
    start = InitialPoses(POSES, source, (source,) * 4, trials, POSES)
    found = _that_won_the_trial(CANDIDATES, start)
    assert (None if found is None else NAMES[found]) == name


def test_refined_poses_are_kept_where_no_evidence_tells_them_from_the_inputs():
    alike = {"tracks": np.ones(4, np.bool_)}
    assert NAMES[_kept_on_a_tie(CANDIDATES, {"tracks"}, alike)] == "refined"
    assert NAMES[_kept_on_a_tie(CANDIDATES, {"tracks"}, {"tracks": ~alike["tracks"]})] == "input"
