"""PSNR and SSIM against scikit-image's."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from skimage.metrics import peak_signal_noise_ratio, structural_similarity

from biresnerf.refinement.views.image_metrics import psnr, shift_px, ssim


def pair(height: int, width: int, noise: float) -> tuple[np.ndarray, np.ndarray]:
    rng = np.random.default_rng([height, width])
    y, x = np.mgrid[:height, :width] / 9.0
    photo = np.stack([np.sin(x) * np.cos(y), np.sin(2 * x + y), np.cos(x - 3 * y)], -1) / 2 + 0.5
    return photo, np.clip(photo + rng.normal(0, noise, photo.shape), 0, 1)


@pytest.mark.parametrize("noise", [0.003, 0.05, 0.4])
@pytest.mark.parametrize(("height", "width"), [(40, 64), (33, 11), (11, 50)])
def test_both_equal_scikit_image(height, width, noise):
    photo, image = pair(height, width, noise)
    ours = psnr(torch.from_numpy(image), torch.from_numpy(photo))
    assert ours == pytest.approx(peak_signal_noise_ratio(photo, image, data_range=1), abs=1e-6)
    # Its mean leaves out the border that the window of 11 px reaches over, as ours does.
    theirs = structural_similarity(
        photo,
        image,
        data_range=1,
        channel_axis=2,
        gaussian_weights=True,
        sigma=1.5,
        use_sample_covariance=False,
    )
    assert ssim(torch.from_numpy(image), torch.from_numpy(photo)) == pytest.approx(theirs, abs=1e-6)


@pytest.mark.parametrize("shift", [1, 2, 3, 6])
def test_a_psnr_is_worth_the_shift_that_makes_it(shift):
    photo = pair(48, 64, 0.02)[0].astype(np.float32)
    aside, down = (psnr(*map(torch.from_numpy, (a, b))) for a, b in (
        (photo[:, shift:], photo[:, :-shift]), (photo[shift:], photo[:-shift])
    ))  # fmt: skip
    error_db = -10 * np.log10((10 ** (-aside / 10) + 10 ** (-down / 10)) / 2)
    assert shift_px(error_db, photo) == pytest.approx(shift, rel=0.01)
    assert shift_px(120, photo) == pytest.approx(0, abs=1e-3)
    assert shift_px(0, photo) == 16


def test_pixels_that_do_not_count_say_nothing_of_a_shift():
    photo = pair(48, 64, 0.02)[0].astype(np.float32)
    counts = np.ones(photo.shape[:2], np.bool_)
    counts[10:30, 20:50] = False
    spoilt = np.where(counts[..., None], photo, np.float32(7))
    assert shift_px(20, spoilt, counts) == pytest.approx(shift_px(20, photo, counts))


def test_identical_images_give_the_best_values():
    photo = torch.from_numpy(pair(20, 20, 0.1)[0])
    assert psnr(photo, photo) == pytest.approx(120)
    assert ssim(photo, photo) == pytest.approx(1)


@pytest.mark.parametrize(("height", "width"), [(5, 40), (1, 1), (8, 8)])
def test_images_smaller_than_the_window_still_have_a_similarity(height, width):
    photo, image = (torch.from_numpy(x).float() for x in pair(height, width, 0.1))
    assert -1 <= ssim(image, photo) < 1
    assert ssim(photo, photo) == pytest.approx(1)
