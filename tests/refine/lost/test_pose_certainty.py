"""Which cameras are sure: none before a body that looks alike from all sides, all before one that does not."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np
import torch
from torch import Tensor

from biresnerf.data.synthetic.scene import synthetic_cameras, synthetic_focal
from biresnerf.field.radiance_field import Rendering
from biresnerf.geometry.camera.camera_models import Camera
from biresnerf.refine.lost.pose_certainty import unsure_deg
from biresnerf.refine.optimise.joint_optimiser import JointOptimiser
from biresnerf.refine.parameters.rigid_bodies import RigidBodies
from biresnerf.refine.scene.scene_frame import scene_frame
from biresnerf.refine.verdict.run_report import unsure_warnings
from tests.refine.tiny_scene import CPU, photos_set, tiny_options, tiny_set

VIEWS, SIZE = 10, 32
RADIUS, EDGE = 0.6, 0.05
FIXED = 4
Paint = Callable[[Tensor], Tensor]


def rings(point: Tensor) -> Tensor:
    """Colours [n, 3] that change with the height alone: a turned vase."""
    return 0.5 + 0.3 * torch.sin(point[:, 2:] * torch.tensor([3.0, 5.0, 7.0]))


def patches(point: Tensor) -> Tensor:
    return 0.5 + 0.3 * torch.sin(7 * point + torch.tensor([0.0, 1.0, 2.0]) + 4 * point.roll(1, 1))


def seen(origin: Tensor, direction: Tensor, paint: Paint) -> tuple[Tensor, Tensor]:
    """Colour over white and opacity of a painted ball with a soft edge, where rays [n, 3] look."""
    along = -(origin * direction).sum(1, keepdim=True)
    nearest = (origin + along * direction).norm(dim=1, keepdim=True)
    hit = origin + (along - (RADIUS**2 - nearest**2).clamp(min=0).sqrt()) * direction
    opacity = torch.sigmoid((RADIUS - nearest) / EDGE)
    return opacity * paint(hit) + 1 - opacity, opacity[:, 0]


class ExactField(JointOptimiser):
    """Renders the ball itself: what a field would if it were exact."""

    paint: Paint
    haze = 0.0

    def render(self, origin, direction, *_args, **_kwargs) -> Rendering:
        world = self.frame.unit_from_world.inverse()
        linear, shift = (torch.from_numpy(np.asarray(a)).float() for a in (world.rotation, world.translation))
        at = world.scale * (origin @ linear.T) + shift
        colour, opacity = seen(at, direction @ linear.T, self.paint)
        return Rendering(colour + self.haze, opacity, torch.zeros_like(opacity), len(origin))


def photographed(paint: Paint) -> ExactField:
    poses, focal = synthetic_cameras(VIEWS, seed=3), synthetic_focal(SIZE)
    y, x = torch.meshgrid(torch.arange(SIZE) + 0.5, torch.arange(SIZE) + 0.5, indexing="ij")
    in_cam = torch.stack([(x - SIZE / 2) / focal, (y - SIZE / 2) / focal, torch.ones_like(x)], -1).reshape(
        -1, 3
    )
    in_cam = in_cam / in_cam.norm(dim=1, keepdim=True)
    photos = []
    for pose in torch.from_numpy(poses).float():
        direction = in_cam @ pose[:3, :3].T
        colour = seen(pose[:3, 3].expand_as(direction), direction, paint)[0]
        photos.append((255 * colour).round().byte().numpy().reshape(SIZE, SIZE, 3))
    camera = Camera("SIMPLE_PINHOLE", SIZE, SIZE, (focal, SIZE / 2, SIZE / 2))
    images = replace(photos_set(photos), cameras=(camera,) * VIEWS, background=np.ones(3, np.float32))
    frame = scene_frame(poses, images)
    start = frame.unit_from_world.apply_to_poses(poses)
    bodies = replace(RigidBodies.free(VIEWS), fixed=np.arange(VIEWS) == FIXED)
    optimiser = ExactField(images, frame, start, tiny_options(), [], CPU, 2, bodies=bodies)
    optimiser.paint = paint
    return optimiser


def test_before_a_body_of_revolution_a_photo_does_not_say_from_which_side_it_was_taken():
    optimiser = photographed(rings)
    optimiser.haze = 0.01  # no field is exact
    unsure = unsure_deg(optimiser)
    assert (np.delete(unsure, FIXED) > 0).all()
    assert unsure[FIXED] == 0  # where it is has been said


def test_before_the_same_body_with_patches_every_photo_says_where_it_was_taken():
    optimiser = photographed(patches)
    optimiser.haze = 0.01
    assert not unsure_deg(optimiser).any()


def test_a_field_that_leaves_texture_unexplained_has_no_say():
    optimiser = photographed(rings)
    optimiser.haze = 0.1
    assert not unsure_deg(optimiser).any()


def test_the_warning_names_those_alone_that_are_not_sure(tmp_path):
    dataset, _ = tiny_set(tmp_path, views=5)
    (warning,) = unsure_warnings(dataset, np.array([0.0, 8, 0, 32, 0]))
    assert [name in warning for name in dataset.names] == [False, True, False, True, False]
    assert "2 of 5" in warning
    assert "8 degrees" in warning
    assert unsure_warnings(dataset, np.zeros(5)) == ()
