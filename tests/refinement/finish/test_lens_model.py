"""Which parameters of an unknown lens are freed: those that tracks determine and left-out tracks confirm."""

from dataclasses import replace

import numpy as np
import pytest

from biresnerf.geometry.camera.camera import Intrinsics
from biresnerf.geometry.camera.camera_models import Camera
from biresnerf.refinement.adjustment.evidence import Evidence, PosePrior
from biresnerf.refinement.adjustment.lens.lenses import CENTRE, LENS, Lenses
from biresnerf.refinement.finish.lens_model import supported_lenses
from tests.refinement.adjustment.rig import FOCAL, SIZE, disturbed, observed, ring

CAMERAS = 10


def plain(right=0.0, down=0.0):
    return Camera("SIMPLE_RADIAL", SIZE, SIZE, (FOCAL, SIZE / 2 + right, SIZE / 2 + down, 0.0))


@pytest.mark.parametrize(
    ("centre", "freed"), [((4.5, -3.5), True), ((0.0, 0.0), False)], ids=["off the middle", "in the middle"]
)
def test_a_principal_point_is_freed_where_it_is_off_the_middle(centre, freed):
    """By three and a half standard deviations of what 250 features tell; many left-out ones see it well."""
    rng = np.random.default_rng(3)
    truth = ring(CAMERAS, rng)
    true_lens = Intrinsics.from_cameras([plain(*centre)] * CAMERAS)
    fitted, left_out = (
        observed(truth, rng.uniform(-0.8, 0.8, (count, 3)), true_lens, rng, 0.5) for count in (250, 3000)
    )
    deviation = np.array([[0.1, 0.1, 0.0, 0.02, 0.02, 0.0, 0.0, 0.0]])
    lenses = Lenses(np.zeros(CAMERAS, np.int64), np.zeros((1, LENS)), deviation)
    evidence = Evidence(Intrinsics.from_cameras([plain()] * CAMERAS), fitted, lenses=lenses)
    start = disturbed(truth, rng, 0.005, 0.02)
    found = supported_lenses(
        start, evidence, replace(evidence, tracks=left_out), PosePrior.equal(start, 0.1, 0.4), [plain()], lambda: None
    )  # fmt: skip
    assert found.free[0, CENTRE].all() == freed
    assert found.free[0, 0]
