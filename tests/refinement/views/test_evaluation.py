"""Views kept out, the orbit's cameras, whole renders and held-out poses fitted to a frozen field."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation

from biresnerf.data.synthetic.scene import synthetic_cameras
from biresnerf.refinement.optimise.method_changes import changed
from biresnerf.refinement.optimise.renderer import Renderer
from biresnerf.refinement.views.evaluation import fit_held_out_poses, orbit_poses, render_view, score_views
from tests.refinement.tiny_scene import tiny_optimiser, tiny_options, tiny_set

pytestmark = pytest.mark.slow


def turned(rig: np.ndarray) -> np.ndarray:
    tilt = np.eye(4)
    tilt[:3, :3] = Rotation.from_euler("xyz", [40, 25, 10], degrees=True).as_matrix()
    return tilt @ rig


def arc(reach_deg: float, count: int = 15) -> np.ndarray:
    start = synthetic_cameras(11, 4)[5]
    turns = np.linspace(-reach_deg / 2, reach_deg / 2, count)
    rotation = Rotation.from_euler("z", turns[:, None], degrees=True).as_matrix()
    rig = np.tile(np.eye(4), (count, 1, 1))
    rig[:, :3] = rotation @ start[:3]
    return rig


RIGS = {
    "dome": synthetic_cameras(40, 0),
    "tilted dome": turned(synthetic_cameras(40, 0)),
    "arc": arc(60),
    "tilted arc": turned(arc(60)),
    "one camera": synthetic_cameras(40, 0)[7:8],
    "all in one place": np.repeat(synthetic_cameras(40, 0)[7:8], 4, axis=0),
}


@pytest.mark.parametrize("rig", RIGS.values(), ids=RIGS.keys())
def test_orbit_cameras_are_rigid_and_look_at_the_centre(rig):
    poses = orbit_poses(rig, 24)
    assert poses.shape == (24, 3, 4)
    rotation, eye = poses[:, :, :3], poses[:, :, 3]
    np.testing.assert_allclose(
        rotation @ rotation.transpose(0, 2, 1), np.tile(np.eye(3), (24, 1, 1)), atol=1e-9
    )
    np.testing.assert_allclose(np.linalg.det(rotation), 1)
    in_cam = np.einsum("nji,nj->ni", rotation, -eye)  # the origin as each camera sees it
    np.testing.assert_allclose(in_cam[:, :2], 0, atol=1e-9)
    assert (in_cam[:, 2] > 0).all()


@pytest.mark.parametrize("rig", RIGS.values(), ids=RIGS.keys())
def test_orbit_cameras_are_upright_as_the_rig_is_and_about_as_far_away(rig):
    poses = orbit_poses(rig, 24)
    up = -rig[:, :3, 1].mean(0)
    assert (-poses[:, :, 1] @ up > 0).all()
    distance, given = np.linalg.norm(poses[:, :, 3], axis=1), np.linalg.norm(rig[:, :3, 3], axis=1)
    assert 0.5 * given.min() < distance.min()
    assert distance.max() < 1.1 * given.max()


def test_a_full_rig_is_circled_and_a_narrow_one_swung_over():
    full = orbit_poses(RIGS["dome"], 24)[:, :, 3]
    azimuth = np.unwrap(np.arctan2(full[:, 1], full[:, 0]))
    assert abs(np.diff(azimuth)).sum() == pytest.approx(2 * np.pi * 23 / 24, rel=0.01)  # up is not quite z
    swing = orbit_poses(RIGS["arc"], 24)[:, :, 3]
    nearest = np.linalg.norm(swing[:, None] - RIGS["arc"][None, :, :3, 3], axis=2).min(1)
    assert nearest.max() < 0.15 * np.linalg.norm(RIGS["arc"][0, :3, 3])  # never leaves what the rig has seen


@pytest.fixture(scope="module")
def trained(tmp_path_factory):
    dataset, images = tiny_set(tmp_path_factory.mktemp("scene"))
    optimiser = tiny_optimiser(dataset, images, tiny_options(), held_out=[3])
    for _ in range(20):
        optimiser.step()
    return optimiser, images


def test_a_whole_view_has_every_pixel_once_in_its_place(trained):
    optimiser, images = trained
    view = render_view(optimiser.renderer, optimiser.poses.matrices().detach()[2], 2)
    assert view.colour.shape == (*images.image(2).shape[:2], 3)
    assert view.depth.shape == view.opacity.shape == images.image(2).shape[:2]
    assert 0 <= view.colour.min() <= view.colour.max() <= 1
    # One pixel by itself: the same ray gives the same colour.
    with torch.no_grad():
        matrix = optimiser.poses.matrices()[2:3]
        renderer = optimiser.renderer
        alone = renderer.render(*renderer.cast(matrix, torch.tensor([2]), torch.tensor([[17.5, 6.5]])))
    np.testing.assert_allclose(view.colour[6, 17], alone.colour[0].numpy(), atol=1e-6)


def test_a_young_field_looks_the_same_at_coarser_intervals(trained, monkeypatch):
    optimiser, _ = trained
    matrix, samples, render = optimiser.poses.matrices().detach()[2], [], Renderer.render

    def counted(*rays, **how):
        rendering = render(*rays, **how)
        samples.append(rendering.samples)
        return rendering

    monkeypatch.setattr(Renderer, "render", counted)
    fine, coarse = (render_view(optimiser.renderer, matrix, 2, coarser=times).colour for times in (1.0, 2.0))
    assert samples[1] < 0.6 * samples[0]
    assert -10 * np.log10(((fine - coarse) ** 2).mean()) > 40


def test_fitting_held_out_poses_moves_them_alone_and_no_field(trained, monkeypatch):
    optimiser, _ = trained
    monkeypatch.setattr(optimiser, "method", changed(optimiser.method, {"views.fit_steps": 8}))
    before = {
        k: v.clone()
        for k, v in optimiser.state().items()
        if k.startswith(("field.pose_table", "field.network"))
    }
    poses = optimiser.poses.matrices().detach().clone()
    fit_held_out_poses(optimiser, [3])
    after = optimiser.poses.matrices().detach()
    assert [i for i in range(len(poses)) if not torch.equal(poses[i], after[i])] == [3]
    for name, tensor in before.items():
        assert torch.equal(optimiser.state()[name], tensor), name


def test_poses_are_fitted_for_no_more_steps_than_the_field_was_trained(trained, monkeypatch):
    optimiser, _ = trained
    monkeypatch.setattr(optimiser, "options", optimiser.options.model_copy(update={"steps": 3}))
    steps, step = [], optimiser.poses.step
    monkeypatch.setattr(optimiser.poses, "step", lambda *rate: (steps.append(rate), step(*rate)))
    fit_held_out_poses(optimiser, [3])
    assert len(steps) == 3


def test_exposures_of_held_out_views_whose_poses_are_held_are_fitted_to_one_rendering(tmp_path, monkeypatch):
    dataset, images = tiny_set(tmp_path)
    options = tiny_options(exposure="on")
    first = tiny_optimiser(dataset, images, options, held_out=[3])
    for _ in range(20):
        first.step()
    true = torch.tensor([0.9, 1.1, 0.85])
    with torch.no_grad():
        first.exposure.log_gain[3] = true.log()
    shown = render_view(first.renderer, first.poses.matrices().detach()[3], 3, as_photo=True).colour
    pixels = images.pixels.copy()
    pixels[int(images.offsets[3]) : int(images.offsets[4])] = np.rint(255 * shown).reshape(-1, 3)
    optimiser = tiny_optimiser(dataset, replace(images, pixels=pixels), options, held_out=[3])
    optimiser.load_state(first.state(), first.step_state())
    optimiser.exposure.forget(3)
    optimiser.poses_held, poses = True, optimiser.poses.matrices().detach().clone()
    calls, render = [], Renderer.render
    monkeypatch.setattr(Renderer, "render", lambda *rays, **how: calls.append(how) or render(*rays, **how))
    fit_held_out_poses(optimiser, [3])
    assert torch.equal(optimiser.poses.matrices().detach(), poses)
    assert len(calls) == 1
    np.testing.assert_allclose(optimiser.exposure.gains()[3], true, rtol=0.02)


def test_scores_compare_the_render_of_each_view_with_its_own_photo(trained):
    optimiser, images = trained
    scores = list(score_views(optimiser.renderer, images, [1, 3]))
    assert [score.image for score in scores] == [1, 3]
    for score in scores:
        photo = images.image(score.image) / 255
        assert score.psnr == pytest.approx(
            -10 * np.log10(((score.view.colour - photo) ** 2).mean()), abs=1e-3
        )
