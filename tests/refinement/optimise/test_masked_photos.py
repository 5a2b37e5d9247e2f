"""What lies under a mask has no part in anything: not in targets, errors, repairs or scores."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch

from biresnerf.data.photos.images import ImageSet
from biresnerf.refinement.lost.lost_cameras import LostCameraRepair
from biresnerf.refinement.numbers.scene import FrameNumbers
from biresnerf.refinement.optimise.camera_errors import CameraErrors, foreground_shares
from biresnerf.refinement.optimise.method_changes import changed
from biresnerf.refinement.optimise.methods import BIRESNERF
from biresnerf.refinement.optimise.photo_sampler import PhotoSampler
from biresnerf.refinement.optimise.pose_hypotheses import photo_distances
from biresnerf.refinement.scene.scene_frame import scene_frame
from biresnerf.refinement.views.evaluation import fit_held_out_poses, score_views
from biresnerf.refinement.views.image_metrics import psnr, ssim
from tests.refinement.tiny_scene import CPU, photos_set, tiny_optimiser, tiny_options, tiny_set


def generator(seed: int = 0) -> torch.Generator:
    return torch.Generator().manual_seed(seed)


def two_coloured() -> ImageSet:
    """Green photos with red under the mask: a ragged third of each."""
    rng = np.random.default_rng(2)
    photos, masks = [], []
    for height, width in ((40, 56), (33, 47)):
        counts = rng.random((height, width)) < 0.8
        counts[height // 3 : height // 2] = False
        photos.append(np.where(counts[..., None], (10, 200, 30), (250, 0, 90)).astype(np.uint8))
        masks.append(counts.reshape(-1))
    return replace(photos_set(photos), counts=np.concatenate(masks))


def test_masked_pixels_are_never_drawn_and_all_others_are():
    images = two_coloured()
    batch = PhotoSampler(images, [], CPU).draw(60_000, 0.0, generator())
    drawn = {(i, int(y), int(x)) for i, (x, y) in zip(batch.image.tolist(), batch.xy.tolist(), strict=True)}
    counting = {(i, *place) for i in range(2) for place in np.argwhere(images.counts_image(i)).tolist()}
    assert drawn == counting
    assert bool((batch.sharp[:, 1] > 0.7).all())


def test_pixels_that_count_are_drawn_equally_often():
    images = two_coloured()
    batch = PhotoSampler(images, [], CPU).draw(200_000, 0.0, generator())
    of_first = batch.xy[batch.image == 0].long()
    often = torch.bincount(of_first[:, 1] * 56 + of_first[:, 0], minlength=56 * 40).numpy()
    often = often[images.counts_image(0).reshape(-1)]
    assert often.std() == pytest.approx(np.sqrt(often.mean()), rel=0.1)  # as counts of even chances spread


@pytest.mark.parametrize("sigma", [0.6, 1.3, 4.0, 8.0])
def test_no_blur_mixes_in_a_masked_colour(sigma):
    sampler = PhotoSampler(two_coloured(), [], CPU)
    batch = sampler.draw(4000, 0.0, generator())
    blurred = sampler.colours(batch.image, batch.xy, sigma) * 255
    assert float((blurred - torch.tensor([10.0, 200, 30])).abs().max()) <= 1.01  # bytes at each level


def test_scores_see_nothing_of_masked_pixels():
    rng = np.random.default_rng(0)
    photo, image = (torch.from_numpy(rng.random((30, 40, 3))) for _ in range(2))
    counts = torch.from_numpy(rng.random((30, 40)) < 0.7)
    spoilt = torch.where(counts[..., None], image, torch.rand(30, 40, 3, generator=generator()).double())
    assert psnr(image, photo, counts) == pytest.approx(psnr(spoilt, photo, counts))
    assert ssim(image, photo, counts) == pytest.approx(ssim(spoilt, photo, counts))
    assert psnr(image, photo, counts) != pytest.approx(psnr(image, photo), abs=1e-3)
    everywhere = torch.ones_like(counts)
    assert psnr(image, photo, everywhere) == pytest.approx(psnr(image, photo))
    assert ssim(image, photo, everywhere) == pytest.approx(ssim(image, photo))
    assert ssim(photo, photo, counts) == pytest.approx(1)


@pytest.fixture(scope="module")
def spoilt_twice(tmp_path_factory) -> tuple:
    """The tiny scene and its photos with two kinds of rubbish under the same masks."""
    dataset, images = tiny_set(tmp_path_factory.mktemp("scene"))
    rng = np.random.default_rng(1)
    counts = np.ones(len(images.pixels), dtype=bool)
    for i in range(len(images)):
        patch = counts[images.offsets[i] : images.offsets[i + 1]].reshape(24, 24)
        row, column = rng.integers(0, 14, 2)
        patch[row : row + 10, column : column + 8] = False
    sets = []
    for rubbish in (np.uint8(0), rng.integers(0, 256, images.pixels.shape, dtype=np.uint8)):
        pixels = np.where(counts[:, None], images.pixels, rubbish)
        alpha = np.where(counts, images.alpha, rng.integers(0, 256, len(counts))).astype(np.uint8)
        sets.append(replace(images, pixels=pixels, alpha=alpha, counts=counts))
    return dataset, *sets


def test_measures_of_photos_do_not_depend_on_what_is_masked(spoilt_twice):
    dataset, one, other = spoilt_twice
    for measure in (
        foreground_shares,
        photo_distances,
        lambda images: CameraErrors(images, [], CPU)._variances.numpy(),
    ):
        np.testing.assert_allclose(measure(one), measure(other), atol=1e-6)
    assert (
        scene_frame(dataset.world_from_cam, one, FrameNumbers()).distance
        == scene_frame(dataset.world_from_cam, other, FrameNumbers()).distance
    )


def test_a_run_does_not_depend_on_what_is_masked(spoilt_twice):
    """Steps of both stages, a repair, fitting held-out poses, and scores: all the same to the bit."""
    method = changed(BIRESNERF, {"lost.rounds": ((2, 24, 3), (1, 48, 3)), "views.fit_steps": 5})
    dataset, *sets = spoilt_twice
    results = []
    for images in sets:
        optimiser = tiny_optimiser(dataset, images, tiny_options(), [3], method)
        for step in range(16):
            if step == 8:
                optimiser.camera_errors.close_block()
                LostCameraRepair(optimiser)._repair(1, 0.0, torch.ones(7, dtype=torch.bool), alone=False)
                optimiser.start_reconstruction()
            optimiser.step()
        fit_held_out_poses(optimiser, [3])
        score = next(score_views(optimiser.renderer, images, [3]))
        results.append((optimiser.poses.poses().numpy(), score.psnr, score.ssim))
    (poses, *scores), (other_poses, *other_scores) = results
    assert np.array_equal(poses, other_poses)
    assert scores == other_scores
