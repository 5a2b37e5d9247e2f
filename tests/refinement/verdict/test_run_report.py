"""The warnings of a report."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from biresnerf.data.points.tracks import Tracks
from biresnerf.data.seeding.initial_poses import InitialPoses
from biresnerf.refinement.verdict.pose_uncertainty import FIXED, LOST, OPEN
from biresnerf.refinement.verdict.run_report import _unknown_warnings, turntable_warnings, unmatched_warnings
from biresnerf.report import TrialReport
from biresnerf.uncertainty import PoseUncertainty
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


def test_poses_of_unknown_accuracy_are_named_for_each_reason_but_those_kept_on_request(tmp_path):
    dataset = tiny_set(tmp_path, views=5, size=16)[0]
    known = PoseUncertainty(known_from="matches", rotation_deg=0.1, position=0.1, position_percent=1.0)
    open_, lost, fixed = (
        PoseUncertainty(known_from="nothing", why_unknown=why) for why in (OPEN, LOST, FIXED)
    )
    found = _unknown_warnings(dataset, (known, open_, fixed, lost, open_))
    assert [warning.split(" of 5")[0] for warning in found] == ["The accuracy of 2", "The accuracy of 1"]
    named = [{i for i, name in enumerate(dataset.names) if name in warning} for warning in found]
    assert named == [{1, 4}, {3}]
    assert OPEN in found[0]
    assert LOST in found[1]
    assert _unknown_warnings(dataset, (known, fixed, known, fixed, known)) == ()
    assert _unknown_warnings(dataset, ()) == ()
