"""One step, and the switch, which leaves the function unchanged; held-out photos never reach the field."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch

from biresnerf.geometry.camera.camera_models import Camera
from biresnerf.refinement.views.evaluation import render_view
from tests.refinement.tiny_scene import tiny_optimiser, tiny_options, tiny_set


@pytest.fixture(scope="module")
def scene(tmp_path_factory):
    return tiny_set(tmp_path_factory.mktemp("scene"))


def look(optimiser) -> torch.Tensor:
    """Colour, opacity and depth of fixed rays of all cameras."""
    generator = torch.Generator().manual_seed(9)
    image = torch.arange(len(optimiser.poses)).repeat(40)
    xy = torch.rand(len(image), 2, generator=generator) * 24
    with torch.no_grad():
        renderer = replace(optimiser.renderer, marching=optimiser.marching(0.02))
        r = renderer.render(*renderer.cast(optimiser.poses.matrices()[image], image, xy))
    return torch.cat([r.colour, r.opacity[:, None], r.depth[:, None]], 1)


def test_the_switch_leaves_every_render_as_it_was_but_for_merged_intervals(scene):
    optimiser = tiny_optimiser(*scene, tiny_options())
    merging, optimiser.method = optimiser.method, replace(optimiser.method, merging=None)
    for _ in range(20):
        optimiser.step()
    with torch.no_grad():  # only the zero columns may keep the module out, not its tiny features
        optimiser.field.reconstruction_table.uniform_(-1, 1, generator=torch.Generator().manual_seed(1))
    before = look(optimiser)
    assert float(before[:, :3].std()) > 0.01  # there is something to see
    optimiser.start_reconstruction()
    assert float((look(optimiser) - before).abs().max()) < 1e-5
    optimiser.method = merging
    assert 0 < float((look(optimiser) - before).abs().max()) < 0.02
    optimiser.step()
    optimiser.step()
    assert float((look(optimiser) - before).abs().max()) > 1e-5  # from now on it takes part


def test_the_switch_is_no_jump_of_the_loss(scene):
    optimiser = tiny_optimiser(*scene, tiny_options())
    before = [optimiser.step().mean_squared_error for _ in range(40)][-10:]
    optimiser.start_reconstruction()
    after = [optimiser.step().mean_squared_error for _ in range(10)]
    assert np.mean(after) < 1.15 * np.mean(before)


def test_steps_reduce_the_error_and_report_their_effort(scene):
    optimiser = tiny_optimiser(*scene, tiny_options())
    results = [optimiser.step() for _ in range(25)]
    assert np.mean([r.mean_squared_error for r in results[-10:]]) < 0.6 * results[0].mean_squared_error
    assert all(r.rays >= 256 and r.samples > 0 for r in results)
    assert optimiser.step_index == 25


def test_held_out_photos_move_their_own_pose_but_never_the_field(scene):
    dataset, images = scene
    runs = []
    for shade in (0, 255):
        photos = images.pixels.copy()
        photos[images.offsets[2] : images.offsets[3]] = shade
        optimiser = tiny_optimiser(dataset, replace(images, pixels=photos), tiny_options(), held_out=[2])
        optimiser.background = torch.ones(3)
        for _ in range(12):
            optimiser.step()
        runs.append(optimiser)
    dark, light = runs
    for name, tensor in dark.field.state().items():
        assert torch.equal(light.field.state()[name], tensor), name
    differing = [
        i for i in range(len(dataset)) if not torch.equal(dark.poses.matrices()[i], light.poses.matrices()[i])
    ]
    assert differing == [2]


def test_poses_stand_still_in_the_last_steps(scene):
    optimiser = tiny_optimiser(*scene, tiny_options())
    optimiser.step_index = 39
    optimiser.start_reconstruction()
    before = optimiser.poses.matrices().detach().clone()
    optimiser.step()
    assert torch.equal(optimiser.poses.matrices(), before)


def test_another_seed_is_another_run_and_the_same_seed_the_same(scene):
    def run(seed: int) -> torch.Tensor:
        optimiser = tiny_optimiser(*scene, tiny_options(seed=seed))
        for _ in range(8):
            optimiser.step()
        return optimiser.poses.poses()

    assert torch.equal(run(4), run(4))
    assert not torch.equal(run(4), run(5))


def test_a_camera_given_another_pose_starts_over_as_free_as_any(scene):
    optimiser = tiny_optimiser(*scene, tiny_options())
    optimiser.mobility[:, 2] = 0.0
    for _ in range(3):
        optimiser.step()
    other = optimiser.poses.start[4].clone()
    optimiser.replace_pose(2, other)
    assert torch.allclose(optimiser.poses.matrices()[2], other)
    assert bool((optimiser.mobility == 1).all())


def test_rays_count_in_the_loss_and_the_error_by_their_weight(scene):
    results = []
    for factor in (1.0, 2.0):
        optimiser = tiny_optimiser(*scene, tiny_options())
        batch = optimiser.sampler.draw(200, 0.0, torch.Generator().manual_seed(3))
        weighed = replace(batch, weight=factor * batch.weight)
        optimiser.sampler.draw = lambda *_, drawn=weighed: drawn
        results.append(optimiser.step())
    one, two = results
    assert two.loss == pytest.approx(2 * one.loss)
    assert two.mean_squared_error == pytest.approx(2 * one.mean_squared_error)


def test_lost_cameras_weigh_less_in_our_loss_and_in_no_other_methods(scene):
    for method, weighed in (("biresnerf", True), ("biresnerf-paper", False)):
        losses = []
        for lost in (False, True):
            optimiser = tiny_optimiser(*scene, tiny_options(method=method))
            watch = optimiser.camera_errors
            if lost:
                weights = torch.ones(7)
                weights[3] = 0.0
                watch.weights = weights
            losses.append(float(optimiser.step().loss))
        assert (losses[1] < 0.99 * losses[0]) == weighed


def test_a_set_of_several_lenses_with_one_that_sees_behind_itself_is_optimised_and_rendered(scene):
    dataset, images = scene
    behind = Camera("OPENCV_FISHEYE", 24, 24, (8.0, 8.0, 12.0, 12.0, 0.01, 0.0, 0.0, 0.0))
    bent = Camera("SIMPLE_RADIAL", 24, 24, (33.0, 12.0, 12.0, -0.1))
    cameras = (behind, bent, *images.cameras[2:])
    optimiser = tiny_optimiser(dataset, replace(images, cameras=cameras), tiny_options())
    image, corner = torch.tensor([0, 1, 2]), torch.full((3, 2), 0.5)
    _, direction = optimiser.renderer.cast(optimiser.poses.matrices()[image], image, corner)
    forward = optimiser.poses.matrices()[:3, :, 2].detach()
    assert [float(c) > 0 for c in (direction.detach() * forward).sum(1)] == [False, True, True]
    for _ in range(5):
        assert np.isfinite(optimiser.step().loss)
    assert bool(optimiser.poses.matrices().isfinite().all())
    view = render_view(optimiser.renderer, optimiser.poses.matrices()[0].detach(), 0)
    assert view.colour.shape == (24, 24, 3)
    assert np.isfinite(view.colour).all()
