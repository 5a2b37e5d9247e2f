"""Which cameras stand out: on made-up errors, and from batches of known error."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from biresnerf.refinement.numbers.optimise import ErrorNumbers
from biresnerf.refinement.optimise.camera_errors import CameraErrors, foreground_shares, outliers
from tests.refinement.tiny_scene import CPU, photos_set, tiny_set

NONE_HELD_OUT = torch.zeros(40, dtype=torch.bool)


def spread_errors(seed: int, count: int = 40, sigma: float = 0.2) -> torch.Tensor:
    generator = torch.Generator().manual_seed(seed)
    return 0.01 * torch.exp(sigma * torch.randn(count, generator=generator))


@pytest.mark.parametrize("seed", range(5))
def test_no_camera_of_a_healthy_rig_stands_out(seed):
    assert not outliers(spread_errors(seed), NONE_HELD_OUT, ErrorNumbers()).any()


@pytest.mark.parametrize("seed", range(5))
def test_the_camera_with_four_times_the_error_stands_out_alone(seed):
    errors = spread_errors(seed)
    errors[7] = 4 * errors.median()
    assert torch.nonzero(outliers(errors, NONE_HELD_OUT, ErrorNumbers()))[:, 0].tolist() == [7]


def test_neither_factor_nor_deviations_suffice_alone():
    calm = torch.full((40,), 0.01) + 1e-5 * torch.arange(40)
    calm[0] = 0.015  # many deviations, half as much again
    assert not outliers(calm, NONE_HELD_OUT, ErrorNumbers()).any()
    wide = spread_errors(0, sigma=1.0)
    wide[0] = 2.2 * wide.median()  # twice the median, within the spread
    assert not outliers(wide, NONE_HELD_OUT, ErrorNumbers())[0]
    assert outliers(torch.where(torch.arange(40) == 0, 2.2e-2, 1e-2), NONE_HELD_OUT, ErrorNumbers())[0]


def test_held_out_views_are_measured_by_their_own_median():
    errors = spread_errors(1, sigma=0.1)
    held_out = torch.arange(40) < 6
    errors[held_out] *= 3  # the field never saw them
    assert not outliers(errors, held_out, ErrorNumbers()).any()
    errors[2] *= 3
    assert torch.nonzero(outliers(errors, held_out, ErrorNumbers()))[:, 0].tolist() == [2]


def test_held_out_views_too_few_for_a_median_must_stand_out_further():
    errors = spread_errors(1, sigma=0.1)
    held_out = torch.arange(40) < 2
    errors[0] *= 3
    assert not outliers(errors, held_out, ErrorNumbers()).any()
    errors[0] *= 3
    assert torch.nonzero(outliers(errors, held_out, ErrorNumbers()))[:, 0].tolist() == [0]


def test_an_unseen_view_among_few_is_lost_only_if_most_of_its_photo_is_unexplained():
    watch = CameraErrors(striped_set(), [3], CPU)  # a variance of 1/4
    squared = [0.001] * 12
    for share, lost in ((0.3, False), (0.9, True), (0.3, False)):
        squared[3] = share / 4
        for _ in range(6):
            block(watch, squared)
            watch.close_block()
        assert bool(watch.lost[3]) == lost
        assert bool(watch.suspects[3]), "other poses are tried for it all the same"


def striped_set(count: int = 12):
    """Photos of a variance of 1/4: half black, half white, and no background."""
    photo = np.zeros((8, 8, 3), np.uint8)
    photo[:, ::2] = 255
    return photos_set([photo] * count)


def block(watch: CameraErrors, squared: list[float], opacity: float = 1.0) -> None:
    """One block in which camera i is off by the root of `squared`[i] at each of its five rays; NaN: it has none."""
    image = torch.tensor([i for i, value in enumerate(squared) for _ in range(5) if value == value])
    off = torch.tensor(squared)[image].sqrt()[:, None].expand(-1, 3)
    watch.add(image, off, torch.zeros_like(off), torch.full((len(image),), opacity), torch.ones(len(image)))
    watch.close_block()


def test_a_camera_is_lost_once_it_stood_out_twice_in_a_row_and_found_when_it_agrees_again():
    watch = CameraErrors(striped_set(), [], CPU)
    errors = [0.01] * 12
    errors[4] = 0.1
    block(watch, errors)
    assert not watch.lost.any()
    block(watch, errors)
    assert torch.nonzero(watch.lost)[:, 0].tolist() == [4]
    assert watch.relative[4] == pytest.approx(10)
    assert watch.weights[4] == pytest.approx(0.1)
    assert (watch.weights[torch.arange(12) != 4] == 1).all()
    for _ in range(8):
        block(watch, [0.01] * 12)
    assert not watch.lost.any()
    assert watch.weights is None


def test_a_photo_that_is_merely_harder_than_others_is_not_lost():
    """Ten times the median error, but 98 % of the photo's variance is explained."""
    watch = CameraErrors(striped_set(), [], CPU)
    errors = [0.0005] * 12
    errors[4] = 0.005
    for _ in range(3):
        block(watch, errors)
    assert not watch.lost.any()
    assert not watch.suspects.any()


def test_a_camera_that_renders_next_to_nothing_is_lost_whatever_its_error(tmp_path):
    _, images = tiny_set(tmp_path)
    watch = CameraErrors(images, [], CPU)
    image = torch.arange(7).repeat_interleave(5)
    colour = torch.zeros(35, 3)
    opacity = watch.shares[image] * torch.where(image == 3, 0.05, 0.5)
    for _ in range(2):
        watch.add(image, colour, colour, opacity, torch.ones(35))
        watch.close_block()
    assert torch.nonzero(watch.lost)[:, 0].tolist() == [3]


def test_a_camera_without_rays_keeps_what_was_known_of_it():
    watch = CameraErrors(striped_set(), [], CPU)
    errors = [0.01] * 12
    errors[4] = 0.1
    block(watch, errors)
    block(watch, [0.01] * 4 + [float("nan")] + [0.01] * 7)
    assert watch.relative[4] == pytest.approx(10)


def test_errors_are_means_by_the_rays_weights():
    watch = CameraErrors(striped_set(2), [], CPU)
    colour = torch.tensor([[0.0] * 3, [1.0] * 3])
    watch.add(
        torch.zeros(2, dtype=torch.int64), colour, torch.zeros(2, 3), torch.ones(2), torch.tensor([3.0, 1.0])
    )
    watch.close_block()
    assert float(watch.errors[0]) == pytest.approx(0.25)


def test_a_repaired_camera_starts_over():
    watch = CameraErrors(striped_set(), [], CPU)
    errors = [0.01] * 12
    errors[4] = 0.1
    block(watch, errors)
    block(watch, errors)
    watch.forget(4)
    assert not watch.lost.any()
    block(watch, [0.01] * 12)
    assert watch.relative[4] == pytest.approx(1)


def test_all_state_travels():
    watch, other = (CameraErrors(striped_set(), [2], CPU) for _ in range(2))
    errors = [0.01] * 12
    errors[4] = 0.1
    block(watch, errors)
    watch.add(torch.tensor([4]), torch.ones(1, 3), torch.zeros(1, 3), torch.ones(1), torch.ones(1))
    other.load_state({name: tensor.clone() for name, tensor in watch.state().items()})
    for each in (watch, other):
        block(each, errors)
    assert torch.equal(watch.errors, other.errors)
    assert torch.equal(watch.lost, other.lost)
    assert watch.lost[4]


def test_the_share_that_shows_the_scene_is_the_opaque_one_or_what_differs_from_the_background(tmp_path):
    _, images = tiny_set(tmp_path, views=3)
    opaque = [images.alpha_image(i).mean() / 255 for i in range(3)]
    assert foreground_shares(images) == pytest.approx(opaque)
    photo = np.full((8, 8, 3), 255, np.uint8)
    photo[:2] = 100
    plain = photos_set([photo])
    assert foreground_shares(plain) == pytest.approx([1])  # nothing is known to be background
    object.__setattr__(plain, "background", np.ones(3, np.float32))
    assert foreground_shares(plain) == pytest.approx([0.25])


def test_a_guessed_camera_weighs_little_until_it_is_believed(tmp_path):
    images = tiny_set(tmp_path, views=5, size=16)[1]
    errors = CameraErrors(images, [], CPU)
    errors.doubt(np.array([False, True, False, False, True]))
    assert errors.lost.tolist() == errors.suspects.tolist() == [False, True, False, False, True]
    assert errors.weights is not None
    np.testing.assert_allclose(errors.weights, [1, 0.1, 1, 1, 0.1])
    errors.close_block()
    np.testing.assert_allclose(errors.weights, [1, 0.1, 1, 1, 0.1])
    kept = {name: tensor.clone() for name, tensor in errors.state().items()}
    errors.believe(1)
    errors.forget(4)  # it has another pose now
    assert not errors.lost.any()
    assert errors.weights is None
    again = CameraErrors(images, [], CPU)
    again.load_state(kept)
    np.testing.assert_allclose(again.weights, [1, 0.1, 1, 1, 0.1])
