"""Intrinsics as parameters: gradients, what may move, what is written, and the focal length of a known scene."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch

from biresnerf.data.formats.read_dataset import read_dataset
from biresnerf.data.formats.transforms.write_transforms import write_transforms
from biresnerf.data.model.refined_set import refined_set
from biresnerf.data.photos.images import ImageSet
from biresnerf.data.synthetic.scene import render_synthetic, synthetic_cameras, synthetic_focal
from biresnerf.geometry.camera.camera import Intrinsics, directions_in_cam
from biresnerf.geometry.camera.camera_models import FAMILY_MODELS, MODEL_PARAMETERS, Camera
from biresnerf.refinement.numbers.scene import FrameNumbers
from biresnerf.refinement.optimise.joint_optimiser import JointOptimiser
from biresnerf.refinement.optimise.methods import Recipe
from biresnerf.refinement.optimise.renderer import turned, viewing_directions
from biresnerf.refinement.parameters.intrinsics_parameters import (
    COLUMNS,
    FOCAL,
    IntrinsicsParameters,
    lenses_of,
    refined_part,
)
from biresnerf.refinement.parameters.pose_parameters import PoseParameters, dolly_directions
from biresnerf.refinement.scene.scene_frame import scene_frame
from biresnerf.refinement.verdict.run_report import camera_reports
from tests.geometry.camera.lenses import CAMERAS, HEIGHT, WIDTH
from tests.refinement.tiny_scene import photos_set, tiny_optimiser, tiny_options, tiny_set

pytestmark = pytest.mark.slow

CPU = torch.device("cpu")


def lens(model: str, params: tuple[float, ...] | None = None) -> Camera:
    return Camera(model, WIDTH, HEIGHT, params or CAMERAS[model]).resized(64, 48)


def parameters(camera: Camera, part="all", images: int = 2, held_out=()) -> IntrinsicsParameters:
    working = [camera.resized(32, 24)] * images
    return IntrinsicsParameters([camera], [0] * images, [part], working, held_out, CPU)


def fill(lenses: IntrinsicsParameters, size: float = 0.01) -> None:
    with torch.no_grad():
        generator = torch.Generator().manual_seed(1)
        shape = lenses.increments.shape
        change = size * torch.randn(shape, generator=generator, dtype=torch.float64)
        lenses.load_state({"increments": change * lenses.free})


@pytest.mark.parametrize("model", FAMILY_MODELS)
def test_the_working_intrinsics_are_those_of_the_written_camera(model):
    """What the optimiser casts rays with and what a file says afterwards are one camera, in the model as given."""
    lenses = parameters(lens(model))
    fill(lenses)
    written = lenses.refined_working([lens(model)] * 2)[0]
    assert written.model == model
    assert all(a != b for a, b in zip(written.params, lens(model).params, strict=True))
    expected = Intrinsics.from_cameras([written.resized(32, 24)] * 2)
    for name in ("fx", "fy", "cx", "cy", "distortion"):
        torch.testing.assert_close(
            getattr(lenses.intrinsics, name), getattr(expected, name), atol=1e-12, rtol=1e-12
        )


@pytest.mark.parametrize("model", CAMERAS)
def test_only_the_parts_asked_for_and_of_the_model_move(model):
    names = MODEL_PARAMETERS[model]
    for part, moving in (("none", set()), ("focal", {"f", "fx", "fy"} & {*names}), ("all", {*names})):
        lenses = parameters(lens(model), part)
        fill(lenses)
        moved = zip(
            names, lenses.refined_working([lens(model)] * 2)[0].params, lens(model).params, strict=True
        )
        assert {name for name, new, old in moved if new != old} == moving
        assert lenses.moving == (part != "none")
    square = parameters(lens(model), "focal")
    fill(square)
    full, given = square.refined_working([lens(model)] * 2)[0].full(), lens(model).full()
    assert full.fy / full.fx == pytest.approx(given.fy / given.fx, rel=1e-14)


@pytest.mark.parametrize("model", ["PINHOLE", "OPENCV", "FULL_OPENCV", "OPENCV_FISHEYE"])
def test_gradients_of_the_rays_by_every_parameter_are_those_of_finite_differences(tmp_path, model):
    params = CAMERAS[model][:4] + (0.0,) * (
        len(CAMERAS[model]) - 4
    )  # no distortion yet: it may begin all the same
    lenses = parameters(lens(model, params))
    xy = torch.tensor([[15.5, 9.5], [0.5, 0.5], [29.5, 3.5], [7.0, 19.5]], dtype=torch.float64)
    image = torch.tensor([0, 1, 0, 1])
    weight = torch.rand(4, 3, generator=torch.Generator().manual_seed(3), dtype=torch.float64)

    def seen() -> torch.Tensor:
        with torch.no_grad():
            return (directions_in_cam(lenses.differentiable(), image, xy) * weight).sum()

    matrix = torch.eye(3, 4, dtype=torch.float64).expand(4, 3, 4)
    in_cam = viewing_directions(directions_in_cam, lenses.differentiable(), image, xy.float())
    _, direction = turned(matrix.float(), in_cam)
    (direction.double() * weight).sum().backward()
    for column in range(COLUMNS):
        kept = float(lenses.increments[0, column].detach())
        values = []
        for small in (1e-6, -1e-6):
            with torch.no_grad():
                lenses.increments[0, column] = kept + small
            values.append(float(seen()))
        with torch.no_grad():
            lenses.increments[0, column] = kept
        assert float(lenses.increments.grad[0, column]) == pytest.approx(
            (values[0] - values[1]) / 2e-6, abs=2e-5
        )
    assert lenses.increments.grad.isfinite().all()


def test_held_out_photos_teach_the_lens_nothing():
    lenses = parameters(lens("OPENCV"), images=3, held_out=[1])
    q = lenses.differentiable()
    (q.fx[1] + q.distortion[1].sum() + q.cx[1]).backward(retain_graph=True)
    assert not lenses.increments.grad.any()
    q.fx[2].backward()
    assert lenses.increments.grad[0, FOCAL] != 0


def test_a_dolly_leaves_the_picture_at_the_centre_as_it_was():
    poses = torch.from_numpy(synthetic_cameras(5, seed=2))
    points = torch.tensor([[0.3, 0.0, 0.0], [0.0, 0.2, 0.0], [0.0, 0.0, 0.25]], dtype=torch.float64)

    def pixels(matrices: torch.Tensor, focal: float) -> torch.Tensor:
        in_cam = (points - matrices[:, None, :3, 3]) @ matrices[:, :3, :3]
        return focal * in_cam[..., :2] / in_cam[..., 2:]

    p = PoseParameters(poses, 1.0, CPU)
    with torch.no_grad():
        p.rotation += 0.2
        p.translation -= 0.1
    before, aim = p.matrices().detach(), p.translation.clone()
    p.dolly(torch.full((5,), 0.04, dtype=torch.float64))
    after = p.matrices().detach()
    assert torch.equal(p.translation, aim)
    torch.testing.assert_close(after[:, :, :3], before[:, :, :3])
    moved = dolly_directions(before) * np.expm1(0.04)
    torch.testing.assert_close(after[:, :, 3] - before[:, :, 3], moved, atol=1e-6, rtol=1e-4)
    still = pixels(poses, 100.0)
    followed = poses.clone()
    followed[:, :3, 3] += dolly_directions(poses[:, :3]) * np.expm1(0.04)
    zoomed, lone = pixels(followed, 100 * np.exp(0.04)), pixels(poses, 100 * np.exp(0.04))
    assert float((zoomed - still).abs().max()) < 0.1 * float((lone - still).abs().max())


def test_the_gradient_of_a_focal_length_counts_what_the_dolly_costs():
    lenses = parameters(lens("PINHOLE"), "focal", images=4, held_out=[3])
    poses = torch.from_numpy(synthetic_cameras(4, seed=2))[:, :3]
    matrices, _ = lenses.with_gradient(poses)
    assert torch.equal(matrices.detach(), poses)
    weight = torch.rand(4, 3, 4, generator=torch.Generator().manual_seed(1), dtype=torch.float64)
    (matrices * weight).sum().backward()
    expected = (dolly_directions(poses) * weight[:, :, 3])[:3].sum()
    assert float(lenses.increments.grad[0, FOCAL]) == pytest.approx(float(expected), rel=1e-9)


def test_focal_lengths_stay_where_stage_1_left_them_and_other_parts_go_on(scene):
    optimiser = with_lenses(scene, tiny_options(), 1.05, "all")
    for _ in range(10):
        optimiser.step()
    optimiser.start_reconstruction()
    before = optimiser.lenses.increments.detach().clone()
    for _ in range(3):
        optimiser.step()
    after = optimiser.lenses.increments.detach()
    assert before[0, FOCAL] != 0
    assert after[0, FOCAL] == before[0, FOCAL]
    assert bool((after[0, 2:4] != before[0, 2:4]).all())


def test_the_rule_of_auto():
    assert [refined_part("auto", s) for s in ("given", "colmap", "exif", "guessed")] == [
        "none", "none", "focal", "focal",
    ]  # fmt: skip
    assert refined_part("all", "given") == "all"
    assert refined_part("none", "guessed") == "none"


def test_every_file_holds_the_refined_lens_in_the_model_given(tmp_path):
    dataset, images = tiny_set(tmp_path / "scene")
    camera = Camera("SIMPLE_RADIAL", 24, 24, (33.0, 12.0, 12.0, 0.01))
    document = {
        "fl_x": 33.0,
        "fl_y": 33.0,
        "cx": 12.0,
        "cy": 12.0,
        "k1": 0.01,
        "camera_model": "SIMPLE_RADIAL",
    }
    source = replace(dataset.source, document={**document, "frames": None})
    given = replace(dataset, cameras=(camera,), source=source)
    lenses = lenses_of(given, images, "all", [], CPU)
    fill(lenses)
    after = lenses.refined(given)
    assert after.intrinsics_sources == ("refined",)
    assert all(new != old for new, old in zip(after.cameras[0].params, camera.params, strict=True))
    write_transforms(after, given.world_from_cam, tmp_path / "scene" / "out.json")
    assert read_dataset(tmp_path / "scene" / "out.json").cameras == after.cameras
    assert list(refined_set(after, given.world_from_cam).model.cameras.values()) == list(after.cameras)
    report = camera_reports(given, lenses)[0]
    assert (report.params_before, report.params_after) == (camera.params, after.cameras[0].params)
    assert (report.source, report.refined, report.images) == ("given", "all", len(given))


@pytest.fixture(scope="module")
def scene() -> tuple[np.ndarray, ImageSet]:
    """True poses and photos. Not all look at the scene's middle: else a scene of another size would do as well."""
    poses, size = synthetic_cameras(14, seed=3), 28
    poses[:, :3, 3] *= 0.8
    aside = np.random.default_rng(5).uniform(-0.45, 0.45, (len(poses), 2, 1))
    poses[:, :3, 3] += (poses[:, :3, :2] @ aside)[..., 0]
    photos = []
    for pose in poses:
        rgba = render_synthetic(pose, size, 3)[0].astype(np.float32) / 255
        over_white = rgba[..., :3] * rgba[..., 3:] + 1 - rgba[..., 3:]
        photos.append(np.rint(255 * over_white).astype(np.uint8))
    camera = Camera("SIMPLE_PINHOLE", size, size, (synthetic_focal(size), size / 2, size / 2))
    images = replace(photos_set(photos), cameras=(camera,) * len(poses), background=np.ones(3, np.float32))
    return poses, images


def with_lenses(scene, options, factor: float, part: str, *, dollies: bool = True) -> JointOptimiser:
    """An optimiser whose focal length is off by `factor`, its poses those of the truth."""
    poses, images = scene
    true = images.cameras[0]
    wrong = replace(true, params=(true.params[0] * factor, *true.params[1:]))
    images = replace(images, cameras=(wrong,) * len(poses))
    lenses = IntrinsicsParameters([wrong], [0] * len(poses), [part], images.cameras, [], CPU, dollies=dollies)
    frame = scene_frame(poses, images, FrameNumbers())
    start = frame.unit_from_world.apply_to_poses(poses)
    return JointOptimiser(images, frame, start, Recipe.of(options, CPU, 2), [], lenses=lenses)


def test_a_focal_length_5_percent_off_comes_back_towards_the_truth(scene):
    """In 200 steps on photos of 28 px, from either side to within 3.5 %; poses are known."""
    for factor in (1.05, 0.95):
        options = tiny_options(steps=200, coarse_steps_min=100, coarse_steps_max=180, pose_rate_final=0.005)
        optimiser = with_lenses(scene, options, factor, "focal", dollies=False)
        optimiser.mobility[:] = 0.0
        for _ in range(200):
            optimiser.step()
        error = abs(factor * float(optimiser.lenses.increments[0, FOCAL].detach().exp()) - 1)
        assert error < 0.035


def test_a_run_goes_on_from_its_state_to_the_bit(scene):
    options = tiny_options(coarse_steps_min=10)
    first = with_lenses(scene, options, 1.05, "all")
    for _ in range(8):
        first.step()
    saved, numbers = {k: v.clone() for k, v in first.state().items()}, first.step_state()
    for _ in range(3):
        first.step()
    second = with_lenses(scene, options, 1.05, "all")
    second.load_state(saved, numbers)
    for _ in range(3):
        second.step()
    assert bool((first.lenses.increments != 0).any())
    assert torch.equal(first.lenses.increments, second.lenses.increments)
    assert torch.equal(first.lenses.intrinsics.fx, second.lenses.intrinsics.fx)
    assert torch.equal(first.poses.matrices(), second.poses.matrices())


def test_without_refinement_nothing_is_kept_of_the_lenses(tmp_path):
    dataset, images = tiny_set(tmp_path)
    optimiser = tiny_optimiser(dataset, images, tiny_options())
    optimiser.step()
    assert not any(name.startswith("lenses") for name in optimiser.state())
    assert optimiser.lenses.refined(dataset) is dataset
