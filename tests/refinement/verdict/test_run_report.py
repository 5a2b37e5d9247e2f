"""What a report warns of."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from biresnerf.data.points.tracks import Tracks
from biresnerf.data.seeding.initial_poses import InitialPoses
from biresnerf.refinement.verdict.run_report import turntable_warnings, unmatched_warnings
from biresnerf.report import TrialReport
from tests.refinement.tiny_scene import given_scene, tiny_set


def test_of_unplaced_images_only_those_without_tracks_depend_on_their_photo(tmp_path):
    scene = given_scene(*tiny_set(tmp_path, views=10))
    sources = ("colmap",) * 8 + ("given",) * 2
    unplaced = replace(scene, start=replace(scene.start, sources=sources))
    point = np.arange(20).repeat(2)
    image = np.tile([0, 8], 20)  # the ninth shares 20 points with the first, the tenth none
    observed = replace(unplaced, tracks=Tracks.of(point, image, np.zeros((40, 2))))
    without, ninth, tenth = unmatched_warnings(unplaced)[0], *scene.dataset.names[8:]
    assert ninth in without
    assert tenth in without
    (warning,) = unmatched_warnings(observed)
    assert ninth not in warning
    assert tenth in warning
    assert unmatched_warnings(scene) == ()


def test_a_turntable_that_may_have_turned_the_other_way_is_named_and_a_clear_one_is_not():
    def started(better: float, other: float) -> InitialPoses:
        trials = tuple(TrialReport(source="turntable", placed=0, psnr=psnr) for psnr in (better, other))
        return InitialPoses(np.tile(np.eye(4), (3, 1, 1)), "turntable", ("turntable",) * 3, trials)

    (warning,) = turntable_warnings(started(25.1, 25.0))
    assert "mirror image" in warning
    assert turntable_warnings(started(26.0, 25.0)) == ()
    assert turntable_warnings(InitialPoses(np.tile(np.eye(4), (3, 1, 1)), "given", ("given",) * 3)) == ()
