"""Lenses that were not found by photos, as parameters of the optimisation."""

from dataclasses import replace

import numpy as np
import torch

from biresnerf.geometry.camera.camera import Intrinsics, directions_in_cam
from biresnerf.geometry.camera.camera_models import Camera
from biresnerf.refinement.parameters.intrinsics_parameters import lenses_of
from tests.refinement.tiny_scene import CPU, tiny_set


def test_a_placed_lens_is_shown_written_and_kept_and_photos_do_not_move_it(tmp_path):
    dataset, images = tiny_set(tmp_path)
    given = replace(dataset, cameras=(Camera("RADIAL", 24, 24, (33.0, 12.0, 12.0, 0.0, 0.0)),))
    images = replace(images, cameras=given.cameras * len(images))
    found = replace(given.cameras[0], params=(34.0, 12.0, 12.0, 0.05, -0.02))
    lenses = lenses_of(given, images, "none", [], CPU)
    lenses.place(given.cameras, [found])
    after = lenses.refined(given)
    np.testing.assert_allclose(after.cameras[0].params, found.params, rtol=1e-12)
    assert (after.intrinsics_sources, lenses.refined_parts) == (("refined",), ("all",))
    shown = lenses.intrinsics
    index, xy = torch.zeros(3, dtype=torch.int64), torch.tensor([[1.0, 2.0], [12.0, 12.0], [20.0, 5.0]])
    expected = Intrinsics.from_cameras([found])
    torch.testing.assert_close(
        directions_in_cam(shown, index, xy), directions_in_cam(expected, index, xy), rtol=1e-6, atol=1e-6
    )
    lenses.step(0.01)
    assert lenses.refined(given).cameras == after.cameras
    other = lenses_of(given, images, "none", [], CPU)
    other.load_state({name: value.clone() for name, value in lenses.state().items()})
    assert other.refined(given).cameras == after.cameras
