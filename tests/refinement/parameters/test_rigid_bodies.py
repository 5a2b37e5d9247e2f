"""Fixed cameras stay to the bit and tie the frame; the cameras of a rig's moment move as one."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation

from biresnerf.data.formats.colmap.read_model import read_colmap_model
from biresnerf.data.model.colmap_scene import matrix_of_pose
from biresnerf.data.model.dataset import Dataset, Frame, SourceFormat
from biresnerf.errors import InputError
from biresnerf.geometry.perturb import perturb_poses
from biresnerf.geometry.rigid import rigid_inverse
from biresnerf.geometry.rigid_bodies import RigidBodies
from biresnerf.geometry.similarity import Similarity
from biresnerf.options.refine_options import RefineOptions
from biresnerf.refinement.parameters.pose_parameters import PoseParameters
from biresnerf.refinement.parameters.rigid_bodies import rigid_bodies
from tests.data.formats.random_sets import random_model, random_poses
from tests.data.scenes import assert_complete
from tests.refinement.tiny_scene import CPU


def rigged_dataset(*, rigs: bool = True) -> Dataset:
    """Three moments of two cameras, as a COLMAP model holds them."""
    model = random_model(1, rigs=rigs)
    frames = tuple(
        Frame(image.name, Path("/none") / image.name, list(model.cameras).index(image.camera_id),
              rigid_inverse(matrix_of_pose(image.cam_from_world)), "given")
        for image in model.images.values()
    )  # fmt: skip
    source = SourceFormat("images", None, {}, np.eye(4), colmap=model)
    return Dataset(Path("/none"), tuple(model.cameras.values()), frames, source)


def between(poses, groups):
    """Every body's cameras seen from its first one."""
    return [rigid_inverse(poses[group[0]]) @ poses[group] for group in groups]


def test_the_moments_of_a_rig_are_bodies_and_other_images_are_alone():
    dataset = rigged_dataset()
    bodies = rigid_bodies(dataset, RefineOptions())
    names = [{dataset.names[i] for i in group} for group in bodies.shared]
    assert names == [{f"cam7/ä{k}.jpg", f"cam3/ä{k}.jpg"} for k in range(3)]
    assert sorted(set(bodies.of.tolist())) == [0, 1, 2]
    assert rigid_bodies(rigged_dataset(rigs=False), RefineOptions()).shared == []


def test_a_fixed_camera_fixes_its_body_and_names_are_checked():
    dataset = rigged_dataset()
    bodies = rigid_bodies(dataset, RefineOptions(fixed=("cam3/ä1.jpg",)))
    assert {dataset.names[i] for i in np.flatnonzero(bodies.fixed)} == {"cam7/ä1.jpg", "cam3/ä1.jpg"}
    with pytest.raises(InputError) as caught:
        rigid_bodies(dataset, RefineOptions(fixed=("nobody.jpg",)))
    assert_complete(caught.value, "fixed_not_found", "fixed")
    found = replace(dataset, frames=tuple(replace(frame, pose_source="colmap") for frame in dataset.frames))
    with pytest.raises(InputError) as caught:
        rigid_bodies(found, RefineOptions(fixed=(dataset.names[0],)))
    assert_complete(caught.value, "fixed_without_pose", "fixed")


def test_a_start_from_elsewhere_is_brought_to_the_fixed_cameras_and_keeps_its_shape():
    rng = np.random.default_rng(0)
    given = random_poses(rng, 8)
    moved = Similarity(1.7, Rotation.random(random_state=1).as_matrix(), rng.normal(size=3)).apply_to_poses(
        given
    )
    fixed = np.zeros(8, dtype=bool)
    fixed[[1, 4, 6]] = True
    held = RigidBodies(np.arange(8), fixed).held(moved, given)
    np.testing.assert_allclose(held, given, atol=1e-9)
    assert np.array_equal(held[fixed], given[fixed])
    assert np.array_equal(RigidBodies(np.arange(8), fixed).held(given, given), given)


def test_a_rig_torn_by_its_start_is_put_together_again_without_another_scale():
    dataset = rigged_dataset()
    bodies, given = rigid_bodies(dataset, RefineOptions()), dataset.world_from_cam
    held = bodies.held(perturb_poses(given, 0.1, 3), given)
    for one, other in zip(between(held, bodies.shared), between(given, bodies.shared), strict=True):
        np.testing.assert_allclose(one, other, atol=1e-12)
    assert np.abs(held - given).max() > 0.01


def test_cameras_of_a_body_keep_their_places_and_those_of_others_move_apart():
    dataset = rigged_dataset()
    bodies, given = rigid_bodies(dataset, RefineOptions()), dataset.world_from_cam
    poses = PoseParameters(torch.from_numpy(given), 1.3, CPU, body=torch.from_numpy(bodies.of))
    assert torch.equal(poses.matrices(), torch.from_numpy(given[:, :3]).float())
    for _ in range(20):
        ((poses.matrices() - torch.linspace(-1, 1, 12).reshape(3, 4)) ** 2).sum().backward()
        poses.step(1e-2)
    after = poses.poses().numpy()
    for one, other in zip(between(after, bodies.shared), between(given, bodies.shared), strict=True):
        np.testing.assert_allclose(one, other, atol=1e-5)
    apart = between(after, [np.array([0, 2])])[0] - between(given, [np.array([0, 2])])[0]
    assert np.abs(apart).max() > 0.05


def test_bodies_of_one_camera_step_as_if_there_were_no_bodies():
    given = torch.from_numpy(random_poses(np.random.default_rng(2), 4))
    both = [PoseParameters(given, 1.3, CPU, body=body) for body in (None, torch.arange(4))]
    for poses in both:
        for _ in range(3):
            ((poses.matrices() - 1) ** 2).sum().backward()
            poses.step(1e-2, torch.tensor([1.0, 0.5, 0.0, 1.0]))
    assert torch.equal(both[0].matrices(), both[1].matrices())
    assert torch.equal(both[1].matrices()[2], given[2, :3].float())


def test_replacing_one_camera_takes_its_body_along():
    dataset = rigged_dataset()
    bodies, given = rigid_bodies(dataset, RefineOptions()), dataset.world_from_cam
    poses = PoseParameters(torch.from_numpy(given), 1.3, CPU, body=torch.from_numpy(bodies.of))
    ((poses.matrices() - 1) ** 2).sum().backward()
    poses.step(1e-2)
    before = poses.poses().numpy()
    there = torch.from_numpy(random_poses(np.random.default_rng(3), 1))[0, :3].float()
    poses.replace(2, there)
    after = poses.poses().numpy()
    torch.testing.assert_close(poses.matrices()[2], there)
    for one, other in zip(between(after, bodies.shared), between(before, bodies.shared), strict=True):
        np.testing.assert_allclose(one, other, atol=1e-5)
    others = [i for i in range(6) if i not in poses.members(2)]
    np.testing.assert_allclose(after[others], before[others], atol=1e-6)


def test_a_body_moves_as_far_as_its_least_mobile_camera():
    dataset = rigged_dataset()
    bodies = rigid_bodies(dataset, RefineOptions())
    given = torch.from_numpy(dataset.world_from_cam)
    poses = PoseParameters(given, 1.3, CPU, body=torch.from_numpy(bodies.of))
    mobility = torch.ones(6)
    mobility[bodies.shared[1][0]] = 0.0
    ((poses.matrices() - 1) ** 2).sum().backward()
    poses.step(1e-2, mobility)
    still = [i for i in range(6) if torch.equal(poses.matrices()[i], given[i, :3].float())]
    assert still == bodies.shared[1].tolist()


def test_a_single_fixed_camera_leaves_the_scale_about_it_and_two_leave_nothing():
    rng = np.random.default_rng(4)
    given = random_poses(rng, 6)
    fixed = np.zeros(6, dtype=bool)
    fixed[2] = True
    centre = given[2, :3, 3]
    grown = Similarity(1.5, np.eye(3), -0.5 * centre).apply_to_poses(given)
    tie = RigidBodies(np.arange(6), fixed).input_from_optimised(grown, given)
    np.testing.assert_allclose(tie.apply_to_poses(grown), given, atol=1e-12)
    fixed[4] = True
    assert RigidBodies(np.arange(6), fixed).input_from_optimised(grown, given).scale == 1.0
    assert RigidBodies.free(6).input_from_optimised(grown, given) is None


def test_a_rig_ties_the_scale_and_leaves_the_frame():
    dataset = rigged_dataset()
    given = dataset.world_from_cam
    turned = Similarity(1.0, Rotation.random(random_state=5).as_matrix(), np.array([1.0, -2.0, 0.5]))
    tie = rigid_bodies(dataset, RefineOptions()).input_from_optimised(turned.apply_to_poses(given), given)
    assert tie.scale == 1.0
    np.testing.assert_allclose(tie.apply_to_poses(turned.apply_to_poses(given)), given, atol=1e-9)


def test_the_models_reader_is_the_one_that_the_rigs_come_from(tmp_path):
    from biresnerf.data.formats.colmap.write_binary import write_colmap_binary

    model = random_model(1, rigs=True)
    write_colmap_binary(model, tmp_path)
    dataset = rigged_dataset()
    source = replace(dataset.source, colmap=read_colmap_model(tmp_path))
    assert len(rigid_bodies(replace(dataset, source=source), RefineOptions()).shared) == 3
