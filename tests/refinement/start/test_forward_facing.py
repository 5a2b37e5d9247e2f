"""Poses from scratch for forward-facing photos: a rig before a relief, and its mirror image."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from biresnerf.errors import InputError, Interrupted
from biresnerf.refinement.optimise.method_changes import changed
from biresnerf.refinement.optimise.methods import BIRESNERF
from biresnerf.refinement.start.forward_facing import find_forward_facing, mirrored, resemblance_psnr
from tests.refinement.tiny_scene import photos_set, tiny_recipe, tiny_set


def small_rig(seed: int) -> np.ndarray:
    """Cameras near one place that look nearly the same way."""
    rng = np.random.default_rng(seed)
    poses = np.tile(np.eye(4), (6, 1, 1))
    poses[:, :3, :3] = (
        Rotation.random(random_state=seed) * Rotation.from_rotvec(0.05 * rng.normal(size=(6, 3)))
    ).as_matrix()
    poses[:, :3, 3] = [4, 5, 6] + 0.1 * rng.normal(size=(6, 3))
    return poses


@pytest.mark.parametrize("seed", range(3))
def test_a_rig_mirrored_twice_is_itself_and_once_is_a_rig(seed):
    rig = small_rig(seed)
    once = mirrored(rig)
    np.testing.assert_allclose(mirrored(once), rig, atol=1e-9)
    np.testing.assert_allclose(np.linalg.det(once[:, :3, :3]), 1)
    assert np.abs(once - rig).max() > 0.01


def seen(world_from_cam: np.ndarray, points: np.ndarray) -> np.ndarray:
    """Where cameras see points [m, 3], as x/z and y/z [n, m, 2]."""
    in_cam = (points[None] - world_from_cam[:, None, :3, 3]) @ world_from_cam[:, :3, :3]
    return in_cam[..., :2] / in_cam[..., 2:]


def test_to_the_mirrored_rig_the_scene_of_reversed_depth_looks_nearly_the_same():
    far = 50.0  # a scene of size 1, seen from afar: little perspective
    rng = np.random.default_rng(1)
    scene = rng.uniform(-0.5, 0.5, (40, 3))
    # Signs both ways, so that the mean pose faces the scene's centre.
    signs = np.array([(a, b) for a in (-1, 1) for b in (-1, 1)] * 2)
    swing = np.repeat(0.05 * rng.normal(size=(2, 2)), 4, axis=0) * signs[:, :1]
    turns = Rotation.from_rotvec(np.column_stack([swing, np.zeros(8)]))
    rolls = Rotation.from_rotvec(0.2 * signs[:, 1:] * [0, 0, 1])
    rig = np.tile(np.eye(4), (8, 1, 1))
    rig[:, :3, :3] = (turns * rolls).as_matrix()
    rig[:, :3, 3] = turns.apply([0, 0, -far])  # about the scene's centre
    reversed_depth = scene * [1, 1, -1]
    as_it_is = seen(rig, scene)
    motion = np.abs(as_it_is - as_it_is.mean(0)).mean()
    assert np.abs(seen(mirrored(rig), reversed_depth) - as_it_is).mean() < 0.1 * motion
    assert np.abs(seen(rig, reversed_depth) - as_it_is).mean() > 0.2 * motion


def test_resemblance_is_that_of_the_best_mean_of_other_photos():
    rng = np.random.default_rng(0)
    photo = rng.integers(20, 236, (8, 8, 3), dtype=np.uint8)
    brighter, darker = photo + np.uint8(10), photo - np.uint8(12)
    far = rng.integers(0, 256, (8, 8, 3), dtype=np.uint8)
    alone = photos_set([photo, brighter, far])
    assert resemblance_psnr(alone, [0]) == pytest.approx(-20 * np.log10(10 / 255), rel=1e-4)
    both = photos_set([photo, brighter, darker, far])
    assert resemblance_psnr(both, [0]) == pytest.approx(-20 * np.log10(1 / 255), rel=1e-4)


@pytest.mark.slow
def test_cameras_around_a_scene_are_refused(tmp_path):
    recipe = tiny_recipe(
        changed(BIRESNERF, {"start.facing_first_steps": 60, "start.facing_second_steps": 30})
    )
    images = tiny_set(tmp_path, views=8, size=24)[1]
    with pytest.raises(InputError) as caught:
        find_forward_facing(np.tile(np.eye(4), (8, 1, 1)), images, recipe, lambda: False)
    assert caught.value.code == "insufficient_overlap"
    assert caught.value.hint
    with pytest.raises(Interrupted):
        find_forward_facing(np.tile(np.eye(4), (8, 1, 1)), images, tiny_recipe(), lambda: True)
