"""What a report warns of."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from biresnerf.data.points.tracks import Tracks
from biresnerf.refine.verdict.run_report import unmatched_warnings
from tests.refine.tiny_scene import given_scene, tiny_set


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
