"""Perturbation and metric together give the figures that BARF's noise level stands for."""

from __future__ import annotations

import numpy as np
import pytest

from biresnerf.geometry.perturb import perturb_poses
from biresnerf.geometry.pose_error import camera_errors, pose_error
from tests.geometry.rigs import dome


def test_statistics_are_barfs():
    # 100 cameras on a half sphere of radius 4, noise 0.15: rotations turn by sqrt(8 / pi) * 0.15 rad = 13.7
    # deg on average (a Maxwell distribution). Aligned means of a draw: 13.76 +- 0.58 deg for rotations, 0.255
    # +- 0.017 for translation vectors, 0.79 for centres; each draw within 3 sigma of them.
    rotation, translation, centre, turned = [], [], [], []
    for seed in range(30):
        truth = dome(100, np.random.default_rng(1000 + seed), radius=4.0)
        noisy = perturb_poses(truth, 0.15, seed)
        turned.append(camera_errors(noisy, truth).rotation_deg)
        aligned = pose_error(noisy, truth).aligned
        rotation.append(aligned.rotation_deg.mean)
        translation.append(aligned.translation.mean)
        centre.append(aligned.centre_percent.mean / 100 * 4.0)
    assert np.mean(turned) == pytest.approx(np.degrees(np.sqrt(8 / np.pi) * 0.15), rel=0.03)
    assert np.quantile(turned, 0.95) == pytest.approx(23.7, abs=0.7)
    assert np.all(np.abs(np.array(rotation) - 13.76) < 3 * 0.58)
    assert np.all(np.abs(100 * np.array(translation) - 25.5) < 3 * 1.7)
    assert np.mean(rotation) == pytest.approx(13.76, abs=0.3)
    assert np.mean(translation) == pytest.approx(0.255, abs=0.01)
    assert np.mean(centre) == pytest.approx(0.79, abs=0.05)
