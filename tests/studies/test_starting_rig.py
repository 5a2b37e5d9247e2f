"""What a comparison does to true poses: BARF's noise, and errors on top of it that are known camera by camera."""

from __future__ import annotations

import numpy as np
import pytest

from biresnerf.data.formats.read_dataset import read_poses
from biresnerf.data.formats.transforms.read_transforms import read_transforms
from biresnerf.data.formats.transforms.write_transforms import write_transforms
from biresnerf.data.synthetic.scene import write_synthetic_scene
from biresnerf.geometry.focus import focus_point
from biresnerf.geometry.perturb import perturb_poses
from biresnerf.geometry.pose_error import camera_errors, pose_error
from biresnerf.studies.cell import Perturbation
from biresnerf.studies.scenes import starting_rig, with_poses
from tests.geometry.rigs import dome

TRUTH = dome(40, np.random.default_rng(2), radius=4.0)


def test_perturbed_poses_that_are_kept_are_written_as_perturbed(tmp_path):
    """A file's own digits are kept for poses that did not move; those of a comparison are the true ones."""
    write_synthetic_scene(tmp_path / "scene", n_views=4, size=16, seed=1)
    dataset = read_transforms(tmp_path / "scene/transforms.json")
    perturbed = perturb_poses(dataset.world_from_cam, 0.1, 1)
    write_transforms(with_poses(dataset, perturbed), perturbed, tmp_path / "kept.json")
    kept = np.stack(list(read_poses(tmp_path / "kept.json").values()))
    np.testing.assert_allclose(kept, perturbed, atol=1e-9)


def test_the_start_is_barfs_noise_and_no_more():
    # As many cameras as the paper's scenes have: aligned means of 13.76 +- 0.58 deg and 0.255 +- 0.017 a draw.
    truth = dome(100, np.random.default_rng(2), radius=4.0)
    errors = []
    for seed in range(1, 13):
        rig = starting_rig(truth, Perturbation(noise=0.15, seed=seed))
        assert np.array_equal(rig.world_from_cam, perturb_poses(truth, 0.15, seed))
        assert rig.displaced == ()
        errors.append(pose_error(rig.world_from_cam, truth).aligned)
    assert np.mean([e.rotation_deg.mean for e in errors]) == pytest.approx(13.76, abs=0.5)
    assert np.mean([e.translation.mean for e in errors]) == pytest.approx(0.255, abs=0.015)


def test_one_camera_is_turned_in_place_and_the_others_keep_their_noise():
    rig = starting_rig(TRUTH, Perturbation(noise=0.1, seed=3, turn_one_deg=180))
    errors = camera_errors(rig.world_from_cam, perturb_poses(TRUTH, 0.1, 3))
    (turned,) = rig.displaced
    assert errors.rotation_deg[turned] == pytest.approx(180)
    np.testing.assert_allclose(errors.centre, 0, atol=1e-9)
    np.testing.assert_allclose(np.delete(errors.rotation_deg, turned), 0, atol=1e-6)


def test_the_lost_share_orbits_the_scene_by_45_to_180_degrees_and_still_looks_at_it():
    rig = starting_rig(TRUTH, Perturbation(noise=0.0, seed=5, lose_share=0.1))
    errors = camera_errors(rig.world_from_cam, TRUTH)
    assert len(rig.displaced) == 4
    lost = np.isin(np.arange(len(TRUTH)), rig.displaced)
    assert (errors.rotation_deg[lost] >= 45).all()
    np.testing.assert_allclose(errors.rotation_deg[~lost], 0, atol=1e-6)
    focus = focus_point(TRUTH).point
    distance = np.linalg.norm(rig.world_from_cam[:, :3, 3] - focus, axis=1)
    np.testing.assert_allclose(distance, np.linalg.norm(TRUTH[:, :3, 3] - focus, axis=1))


def test_other_seeds_displace_other_cameras_and_the_same_seed_the_same():
    starts = [Perturbation(noise=0.0, seed=seed, lose_share=0.1) for seed in (1, 1, 2)]
    a, b, c = (starting_rig(TRUTH, start) for start in starts)
    assert a.displaced == b.displaced
    assert np.array_equal(a.world_from_cam, b.world_from_cam)
    assert a.displaced != c.displaced


def test_an_identity_start_knows_nothing():
    rig = starting_rig(TRUTH, Perturbation(kind="identity", noise=0.0))
    assert np.array_equal(rig.world_from_cam, np.tile(np.eye(4), (40, 1, 1)))


def test_labels_say_what_was_done_but_not_the_seed():
    assert Perturbation(noise=0.15, seed=7).label == "noise 0.15"
    assert Perturbation(kind="identity").label == "identity"
    both = Perturbation(noise=0.1, turn_one_deg=180, lose_share=0.1)
    assert both.label == "noise 0.1, one camera turned by 180°, 10 % of the cameras lost"
