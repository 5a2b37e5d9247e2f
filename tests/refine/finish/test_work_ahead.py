"""What a run will do besides its steps follows from the set and the options."""

from dataclasses import replace

import numpy as np
import pytest

from biresnerf.data.points.tracks import Tracks
from biresnerf.refine.finish.rounds import FIRST_ROUND, LEARNING
from biresnerf.refine.finish.work_ahead import work_ahead
from tests.refine.tiny_scene import given_scene, tiny_optimiser, tiny_options, tiny_set


@pytest.fixture(scope="module")
def scene(tmp_path_factory):
    return tiny_set(tmp_path_factory.mktemp("scene"))


def ahead(scene, tracks=None, **options):
    dataset, images = scene
    optimiser = tiny_optimiser(dataset, images, tiny_options(**options))
    return work_ahead(replace(given_scene(dataset, images), tracks=tracks), optimiser)


def test_without_tracks_all_steps_are_taken_and_adjusting_is_short(scene):
    tracks = Tracks.of(np.array([0, 0]), np.array([0, 1]), np.ones((2, 2)))
    short, long = ahead(scene), ahead(scene, tracks)
    assert (short.share, long.share) == (1.0, FIRST_ROUND + LEARNING)
    assert short.parts["adjusting"] < long.parts["adjusting"]


def test_the_verdict_takes_time_only_where_it_is_asked_for(scene):
    assert list(ahead(scene, verdict=True).parts) == ["adjusting", "evaluating", "judging"]
    assert list(ahead(scene, verdict=False).parts) == ["adjusting", "evaluating"]


def test_longer_trainings_make_a_longer_verdict(scene):
    parts = [ahead(scene, trial_steps=steps).parts["judging"] for steps in (50, 100)]
    assert parts[1] == pytest.approx(2 * parts[0])


def test_methods_of_others_do_not_adjust(scene):
    assert "adjusting" not in ahead(scene, method="biresnerf-paper").parts
