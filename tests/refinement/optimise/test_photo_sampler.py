"""Random pixels: the right colours from the right images, and blur that is an area average."""

from __future__ import annotations

import tracemalloc

import numpy as np
import pytest
import torch

from biresnerf.refinement.optimise.photo_sampler import PhotoSampler, turned
from tests.refinement.optimise.test_masked_photos import two_coloured
from tests.refinement.tiny_scene import CPU, photos_set


def noise_photos() -> list[np.ndarray]:
    rng = np.random.default_rng(0)
    return [rng.integers(0, 256, (h, w, 3), dtype=np.uint8) for h, w in ((9, 16), (12, 7), (16, 16), (5, 5))]


def generator(seed: int = 0) -> torch.Generator:
    return torch.Generator().manual_seed(seed)


def test_an_unblurred_pixel_is_the_photos_own_at_its_centre():
    photos = noise_photos()
    batch = PhotoSampler(photos_set(photos), [], CPU).draw(1000, 0.0, generator())
    assert torch.equal(batch.target, batch.sharp)
    for image, (x, y), colour in zip(batch.image.tolist(), batch.xy.tolist(), batch.sharp, strict=True):
        assert (x % 1, y % 1) == (0.5, 0.5)
        np.testing.assert_allclose(colour.numpy() * 255, photos[image][int(y), int(x)], atol=1e-4)


def test_every_pixel_of_every_image_is_drawn_in_the_end():
    photos = noise_photos()
    batch = PhotoSampler(photos_set(photos), [], CPU).draw(20_000, 0.0, generator())
    seen = {(i, x, y) for i, (x, y) in zip(batch.image.tolist(), batch.xy.tolist(), strict=True)}
    assert len(seen) == sum(p.shape[0] * p.shape[1] for p in photos)


def test_rays_of_training_views_come_first_and_held_out_ones_last():
    batch = PhotoSampler(photos_set(noise_photos()), [1], CPU).draw(403, 0.0, generator())
    assert 1 not in batch.image[: batch.trained]
    assert set(batch.image[batch.trained :].tolist()) == {1}


@pytest.mark.parametrize("rays", [8, 101, 4096])
def test_every_image_gets_its_even_share_whatever_its_size(rays):
    for seed in range(5):
        batch = PhotoSampler(photos_set(noise_photos()), [2], CPU).draw(rays, 0.0, generator(seed))
        assert len(batch.image) == rays
        counts = torch.bincount(batch.image, minlength=4)
        assert int(counts.max() - counts.min()) <= 2


def test_held_out_views_can_be_drawn_alone():
    batch = PhotoSampler(photos_set(noise_photos()), [1, 3], CPU).draw(
        200, 0.0, generator(), held_out_only=True
    )
    assert set(batch.image.tolist()) == {1, 3}
    assert batch.trained == 0


def test_the_same_generator_draws_the_same_pixels():
    sampler = PhotoSampler(photos_set(noise_photos()), [1], CPU)
    one, other = sampler.draw(300, 3.0, generator(5)), sampler.draw(300, 3.0, generator(5))
    assert torch.equal(one.xy, other.xy)
    assert torch.equal(one.target, other.target)


@pytest.mark.parametrize("by_detail", [0.0, 0.5])
@pytest.mark.parametrize("held_out_only", [False, True])
@pytest.mark.parametrize("rays", [1, 8, 4097])
def test_the_kernel_draws_what_torch_draws(rays, held_out_only, by_detail):
    for images in (photos_set(noise_photos()), two_coloured()):
        sampler = PhotoSampler(images, [1], CPU, by_detail)
        *ours, trained = sampler._drawn_at_once(rays, generator(6), held_out_only)
        *theirs, of_training_views = sampler.defined_draw(rays, generator(6), held_out_only)
        assert trained == of_training_views
        for one, other in zip(ours, theirs, strict=True):
            torch.testing.assert_close(one, other, rtol=1e-6, atol=0)


def edge(height: int = 40, width: int = 48) -> np.ndarray:
    """Dark on the left, bright on the right."""
    photo = np.full((height, width, 3), 40, np.uint8)
    photo[:, width // 2 :] = 200
    return photo


def test_pixels_at_an_edge_are_drawn_more_often_and_weigh_less():
    batch = PhotoSampler(photos_set([edge()]), [], CPU, by_detail=0.5).draw(50_000, 0.0, generator())
    at_edge = (batch.xy[:, 0] - 24).abs() < 8  # a third of the pixels, and all detail
    assert float(at_edge.float().mean()) == pytest.approx(0.5 + 0.5 / 3, rel=0.02)
    assert float(batch.weight[at_edge].max()) == pytest.approx(0.5, rel=0.02)
    assert float(batch.weight.max()) == pytest.approx(2, rel=1e-3), (
        "no more than an even draw of half the rays"
    )


@pytest.mark.parametrize("by_detail", [0.0, 0.5, 0.9])
def test_weighted_sums_over_rays_are_those_over_all_pixels(by_detail):
    photos = [edge(), *noise_photos()]
    batch = PhotoSampler(photos_set(photos), [], CPU, by_detail).draw(400_000, 0.0, generator(2))
    for i, photo in enumerate(photos):
        of_photo = batch.image == i
        colour = (batch.sharp[of_photo] * batch.weight[of_photo, None]).mean(0) * 255
        np.testing.assert_allclose(colour, photo.reshape(-1, 3).mean(0), rtol=0.02)
        assert float(batch.weight[of_photo].mean()) == pytest.approx(1, rel=0.02)


@pytest.mark.parametrize("sigma", [0.7, 1.0, 2.0, 5.0, 50.0])
def test_blur_leaves_a_constant_image_as_it_is(sigma):
    photo = np.full((33, 47, 3), (10, 100, 250), np.uint8)
    sampler = PhotoSampler(photos_set([photo]), [], CPU)
    xy = torch.tensor([[0.5, 0.5], [46.5, 32.5], [20.5, 10.5]])
    colour = sampler._blurred(torch.zeros(3, dtype=torch.long), xy, sigma)
    np.testing.assert_allclose(colour.numpy() * 255, np.tile(photo[0, 0], (3, 1)), atol=1e-3)


@pytest.mark.parametrize("sigma", [0.6, 1.0, 1.7, 3.0, 4.0])
def test_blur_of_a_constant_gradient_is_the_gradient_itself_away_from_the_border(sigma):
    ramp = np.broadcast_to((np.arange(128) * 1.9)[None, :, None], (96, 128, 3))
    photo = np.rint(ramp).astype(np.uint8)
    sampler = PhotoSampler(photos_set([photo]), [], CPU)
    x = torch.arange(32, 96) + 0.5
    xy = torch.stack([x, torch.full_like(x, 40.5)], 1)
    colour = sampler._blurred(torch.zeros(len(x), dtype=torch.long), xy, sigma)[:, 0]
    np.testing.assert_allclose(colour.numpy() * 255, (x.numpy() - 0.5) * 1.9, atol=1.1)  # bytes at each level
    assert abs(float((colour * 255 - (x - 0.5) * 1.9).mean())) < 0.3  # no shift


def test_a_blurred_pixel_in_the_middle_of_a_block_is_the_blocks_mean():
    photo = np.random.default_rng(3).integers(0, 256, (64, 64, 3), dtype=np.uint8)
    sampler = PhotoSampler(photos_set([photo]), [], CPU)
    # Level 2 (sigma 2 px) has boxes of 4 px; a box's centre lies between its four middle pixels.
    colour = sampler._blurred(torch.zeros(1, dtype=torch.long), torch.tensor([[22.0, 38.0]]), 2.0)
    np.testing.assert_allclose(colour[0].numpy() * 255, photo[36:40, 20:24].mean((0, 1)), atol=1.1)


def test_more_blur_leaves_less_detail():
    photo = np.random.default_rng(3).integers(0, 256, (64, 64, 3), dtype=np.uint8)
    sampler = PhotoSampler(photos_set([photo]), [], CPU)
    xy = torch.rand(500, 2, generator=generator()) * 64
    spread = [
        float(sampler._blurred(torch.zeros(500, dtype=torch.long), xy, s).std()) for s in (0.6, 1, 2, 4, 8)
    ]
    assert spread == sorted(spread, reverse=True)
    assert spread[-1] < 0.2 * spread[0]


def test_targets_are_blurred_between_not_at_all_and_as_much_as_asked():
    sampler = PhotoSampler(photos_set(noise_photos()), [], CPU)
    changed = [
        float((batch.target - batch.sharp).abs().mean())
        for batch in (sampler.draw(500, 2.0, generator(seed)) for seed in range(30))
    ]
    assert min(changed) == 0.0
    assert max(changed) > 0.05


def test_the_pyramid_of_all_photos_is_laid_out_without_a_second_copy():
    photos = [np.full((240, 320, 3), i, np.uint8) for i in range(100)]
    images = photos_set(photos)
    tracemalloc.start()
    try:
        sampler = PhotoSampler(images, [], CPU)
        most = tracemalloc.get_traced_memory()[1]
    finally:
        tracemalloc.stop()
    assert most < 1.5 * sampler.pixels.numel()


def test_turned_places_stay_evenly_spread_and_each_is_last_as_often():
    """Rays that buffers have no room for are the last ones."""
    count, rays, draws = 5, 12, 4000
    places, random = (torch.arange(rays) * count) // rays, generator()
    last = torch.zeros(count)
    for _ in range(draws):
        found = turned(places, count, random)
        each = torch.bincount(found, minlength=count)
        assert each.max() - each.min() <= 1
        last[found[-1]] += 1
    assert (last / draws - 1 / count).abs().max() < 5 * (1 / count / draws) ** 0.5
