"""Sets as users bring them: rendered exactly, written as by phones and COLMAP, with the stated errors."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
from click.testing import CliRunner

from biresnerf.commands.poses.make_scene import CAMERAS, KINDS, make_scene_command
from biresnerf.data.formats.read_dataset import read_dataset, read_poses
from biresnerf.data.photos.orientation import shown_from_cam
from biresnerf.data.synthetic.camera_photos import MAKERS
from biresnerf.data.synthetic.captures import TABLE_SCENE, VASE, table_textures, walking_cameras
from biresnerf.data.synthetic.scene import random_textures, render_shapes, synthetic_cameras, synthetic_focal
from biresnerf.errors import InputError
from biresnerf.geometry.perturb import drift_like_a_phone
from biresnerf.geometry.pose_error import rotation_angle_deg
from tests.data.synthetic.test_scene import signed_distance


def make(folder: Path, *options: str) -> Path:
    done = CliRunner().invoke(
        make_scene_command, [str(folder), "--views", "8", "--size", "24", *options], catch_exceptions=False
    )
    assert done.exit_code == 0, done.output
    return folder.with_name(f"{folder.name}.truth.json")


def stacked(path: Path) -> np.ndarray:
    return np.stack(list(read_poses(path).values()))


def test_a_photo_of_the_walk_is_filled_and_its_depth_lies_on_table_things_or_room():
    pose = walking_cameras(5, seed=2)[3]
    width, height, focal = 40, 30, 31.0
    rgba, depth = render_shapes(TABLE_SCENE, table_textures(2), pose, width, height, focal)
    assert rgba.shape == (height, width, 4)
    assert (rgba[..., 3] == 255).all()
    y, x = np.mgrid[:height, :width] + 0.5
    rays = np.stack([(x - width / 2) / focal, (y - height / 2) / focal, np.ones_like(x)], axis=-1)
    points = (rays * depth[..., None].astype(np.float64)).reshape(-1, 3) @ pose[:3, :3].T + pose[:3, 3]
    things = np.stack([signed_distance(shape, points) for shape in TABLE_SCENE if shape.kind != "room"]).min(
        0
    )
    walls = 8.0 - np.linalg.norm(points, axis=1)
    assert np.abs(np.minimum(things, walls)).max() < 1e-4
    assert 0.1 < (np.abs(walls) < 1e-4).mean() < 0.9


def test_the_vase_has_a_fifth_of_the_scenes_contrast(tmp_path):
    make(tmp_path / "vase", "--kind", "vase")
    make(tmp_path / "dome", "--kind", "dome")

    def roughness(folder: Path) -> float:
        from PIL import Image

        pixels = [np.asarray(Image.open(path), np.float64) for path in sorted(folder.rglob("*.png"))]
        inside = [(p[:, 1:, 3] == 255) & (p[:, :-1, 3] == 255) for p in pixels]
        steps = [
            np.abs(np.diff(p[..., :3].mean(-1), axis=1))[mask] for p, mask in zip(pixels, inside, strict=True)
        ]
        return float(np.median(np.concatenate(steps)))

    assert roughness(tmp_path / "vase") < 0.2 * roughness(tmp_path / "dome")


def test_a_phones_poses_drift_in_heading_and_keep_level():
    true = walking_cameras(60, seed=1)
    rise, heading = [], []
    for seed in range(8):
        moved = drift_like_a_phone(true, seed)
        assert rotation_angle_deg(true[0, :3, :3].T @ moved[0, :3, :3]) < 2.0
        level = np.degrees(np.arccos(np.clip((moved[:, :3, 1] * true[:, :3, 1]).sum(1), -1, 1)))
        turned = moved[:, :3, :3] @ true[:, :3, :3].transpose(0, 2, 1)
        heading.append(
            np.degrees(np.arctan2(turned[:, 1, 0] - turned[:, 0, 1], turned[:, 0, 0] + turned[:, 1, 1]))
        )
        rise.append(np.degrees(np.arcsin(np.clip(turned[:, 2, :2], -1, 1))))
        assert level.max() < 12
    spread = np.std(heading, axis=0)
    assert spread[50:].mean() > 3 * spread[:5].mean()
    assert np.std(rise) < 0.4
    assert np.abs(heading).max() < 15


def test_the_phones_file_is_as_apps_write_it_and_its_truth_beside_it(tmp_path):
    truth = make(tmp_path / "phone", "--kind", "phone")
    document = json.loads((tmp_path / "phone/transforms.json").read_text())
    true = json.loads(truth.read_text())
    assert {"fl_x", "fl_y", "cx", "cy", "w", "h", "timestamp", "file_path"} < set(document["frames"][0])
    assert document["frames"][3]["fl_x"] == pytest.approx(1.01 * true["frames"][3]["fl_x"])
    assert not np.allclose(stacked(tmp_path / "phone"), stacked(truth), atol=1e-4)
    up = -stacked(truth)[:, :3, 1].mean(axis=0)
    assert up[1] / np.linalg.norm(up) > 0.95  # y is up
    assert len(read_dataset(tmp_path / "phone")) == 8


def test_every_maker_can_be_asked_for():
    assert ("none", *MAKERS) == CAMERAS


@pytest.mark.parametrize("camera", ["iphone-upright", "android"])
def test_poses_drift_alike_however_the_phone_is_held(tmp_path, camera):
    poses = {}
    for name in ("none", camera):
        make(tmp_path / name, "--kind", "phone", "--camera", name)
        dataset = read_dataset(tmp_path / name)
        poses[name] = dataset.world_from_cam @ np.linalg.inv(shown_from_cam(dataset.frames))
    np.testing.assert_allclose(poses[camera], poses["none"], atol=1e-9)


def test_half_of_the_walk_is_in_the_model_and_all_of_it_in_the_folder(tmp_path):
    truth = make(tmp_path / "half", "--kind", "half")
    dataset = read_dataset(tmp_path / "half")
    assert dataset.source.dialect == "colmap"
    assert (len(dataset), int(dataset.posed.sum())) == (8, 4)
    true = read_poses(truth)
    for frame in dataset.frames:
        if frame.world_from_cam is not None:
            np.testing.assert_allclose(
                frame.world_from_cam, true[f"images/{Path(frame.name).stem}"], atol=1e-9
            )


@pytest.mark.parametrize("kind", KINDS)
def test_ones_own_set_is_taken_for_true_and_left_as_it_is(tmp_path, kind):
    make(tmp_path / "own", "--kind", "dome", "--noise", "0")
    before = {path: path.read_bytes() for path in sorted((tmp_path / "own").rglob("*")) if path.is_file()}
    truth = make(tmp_path / "made", "--kind", kind, "--of", str(tmp_path / "own"))
    np.testing.assert_allclose(stacked(truth), synthetic_cameras(8, 0), atol=1e-9)
    dataset = read_dataset(tmp_path / "made")
    assert len(dataset) == 8
    assert int(dataset.posed.sum()) == {"half": 4, "turntable": 0}.get(kind, 8)
    assert {path: path.read_bytes() for path in before} == before
    width = json.loads(truth.read_text())["fl_x"]
    assert width == pytest.approx(synthetic_focal(24))


def test_a_turntables_cameras_go_once_round_in_steps_as_uneven_as_asked(tmp_path):
    truth = make(tmp_path / "table", "--kind", "turntable", "--noise", "0.2", "--views", "40")
    true = stacked(truth)
    azimuth = np.unwrap(np.arctan2(true[:, 1, 3], true[:, 0, 3]))
    steps = np.diff(azimuth, append=azimuth[0] + 2 * np.pi) / (2 * np.pi / 40)
    assert steps.sum() == pytest.approx(40)
    assert 0.75 < steps.min() < 0.85 < 1.15 < steps.max() < 1.25
    assert np.ptp(true[:, 2, 3]) < 1e-9
    assert not read_dataset(tmp_path / "table").posed.any()


def test_a_set_without_all_its_poses_is_no_truth(tmp_path):
    make(tmp_path / "half", "--kind", "half")
    with pytest.raises(InputError) as caught:
        make(tmp_path / "again", "--of", str(tmp_path / "half"))
    assert caught.value.code == "poses_missing"
    assert not (tmp_path / "again").exists()


def test_the_vase_stands_whole_in_every_view():
    textures = random_textures(len(VASE), 0)
    for pose in synthetic_cameras(6, 0):
        seen = render_shapes(VASE, textures, pose, 32, 32, synthetic_focal(32))[0][..., 3] > 0
        assert seen.mean() > 0.03
        border = np.concatenate([seen[0], seen[-1], seen[:, 0], seen[:, -1]])
        assert not border.any()
