"""Results keep the input's format; a new transforms.json follows nerfstudio's rules."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from biresnerf.data.formats.codec import WriteContext
from biresnerf.data.formats.read_dataset import read_dataset
from biresnerf.data.formats.result_formats import formats_given_back, write_result_formats
from biresnerf.data.formats.simple.llff import LLFF, parse_llff
from biresnerf.data.formats.simple.nerfstudio import write_nerfstudio
from biresnerf.data.formats.transforms.write_transforms import transforms_notes, write_transforms
from biresnerf.data.model.dataset import Dataset, Frame, SourceFormat
from biresnerf.data.model.refined_set import refined_set
from biresnerf.errors import InputError
from biresnerf.geometry.camera.camera_models import FAMILY_MODELS, MODEL_PARAMETERS, Camera
from biresnerf.geometry.perturb import perturb_poses
from tests.data.formats.random_sets import random_camera, random_model, random_poses, random_result
from tests.data.formats.readers import ours, seen_points, through_json_frame
from tests.data.scenes import HEIGHT, WIDTH, assert_complete, nerfstudio_scene, save, write_image
from tests.geometry.camera.lenses import BEYOND_OPENCV

# What nerfstudio 1.1.5 knows (nerfstudio/cameras/cameras.py, CAMERA_MODEL_TO_TYPE).
NERFSTUDIO_MODELS = {"SIMPLE_PINHOLE", "PINHOLE", "SIMPLE_RADIAL", "RADIAL", "OPENCV", "OPENCV_FISHEYE"}
LENS = ("fl_x", "fl_y", "cx", "cy", "h", "w")


def posed_dataset(*models: str) -> Dataset:
    """Images of a set that was no transforms file, by a camera of each model in turn."""
    rng = np.random.default_rng(0)
    cameras = tuple(random_camera(rng, model) for model in models)
    poses = random_poses(rng, 6)
    frames = tuple(
        Frame(f"{i}.jpg", Path(f"/none/images/{i}.jpg"), i % len(models), pose, "given")
        for i, pose in enumerate(poses)
    )
    return Dataset(Path("/none"), cameras, frames, SourceFormat("images", None, {}, np.eye(4)))


def lint_for_nerfstudio(document):
    """What its parser asserts, and what it takes silently in another way than meant (data/dataparsers)."""
    assert document["camera_model"] in NERFSTUDIO_MODELS
    for key in LENS:
        assert key in document or all(key in frame for frame in document["frames"])
    shared = {"k1", "k2", "k3", "k4", "p1", "p2"} & set(document)
    for frame in document["frames"]:
        assert np.array(frame["transform_matrix"]).shape == (4, 4)
        assert "camera_model" not in frame  # it looks for one at the top only
        if shared:  # then it looks for none in frames
            assert not {"k1", "k2", "k3", "k4", "p1", "p2"} & set(frame)
    assert len({frame["file_path"] for frame in document["frames"]}) == len(document["frames"])


@pytest.mark.parametrize("model", sorted({*FAMILY_MODELS} - {*BEYOND_OPENCV}))
@pytest.mark.parametrize("several", [False, True])
def test_nerfstudio_sees_points_where_we_do(tmp_path, model, several):
    dataset = posed_dataset(*[model] * (2 if several else 1))
    refined = perturb_poses(dataset.world_from_cam, 0.05, 1)
    write_transforms(dataset, refined, tmp_path / "transforms.json")
    document = json.loads((tmp_path / "transforms.json").read_text())
    lint_for_nerfstudio(document)
    result = refined_set(dataset, refined)
    for index, frame in enumerate(document["frames"]):
        points = seen_points(result, index)
        assert np.abs(through_json_frame(document, frame, points) - ours(result, index, points)).max() < 0.01


@pytest.mark.parametrize("model", sorted(FAMILY_MODELS))
@pytest.mark.parametrize("several", [False, True])
def test_the_file_for_nerfstudio_follows_its_rules_whatever_the_input_was(tmp_path, model, several):
    refined = random_result(11, model=model, several=several)
    if model in BEYOND_OPENCV:  # without these terms, nerfstudio has that lens
        named = [dict(zip(MODEL_PARAMETERS[model], camera.params, strict=True)) for camera in refined.cameras]
        flat = [tuple((values | dict.fromkeys(BEYOND_OPENCV[model], 0.0)).values()) for values in named]
        cameras = [replace(c, params=params) for c, params in zip(refined.cameras, flat, strict=True)]
        refined = replace(refined, cameras=tuple(cameras))
    write_nerfstudio(refined, tmp_path / "t.json")
    document = json.loads((tmp_path / "t.json").read_text())
    lint_for_nerfstudio(document)
    assert document["ply_file_path"] == "points.ply"
    for index, frame in enumerate(document["frames"]):
        points = seen_points(refined, index)
        assert np.abs(through_json_frame(document, frame, points) - ours(refined, index, points)).max() < 0.01
        assert frame["file_path"] == refined.images[index].file_name


def test_nerfstudio_refuses_what_it_would_misread(tmp_path):
    mixed = random_result(1, model="OPENCV", several=True)
    fisheye = random_result(1, model="OPENCV_FISHEYE").cameras[0]
    for refined in (
        random_result(1, model="FULL_OPENCV"),
        random_result(1, model="THIN_PRISM_FISHEYE"),
        random_result(1, model="FOV"),
        replace(mixed, cameras=(Camera("EUCM", 64, 48, (25.0, 25.0, 32.0, 24.0, 0.6, 1.1)),) * 2),
        replace(mixed, cameras=(mixed.cameras[0], fisheye)),
    ):
        with pytest.raises(InputError) as caught:
            write_nerfstudio(refined, tmp_path / "t.json")
        assert_complete(caught.value, "export_not_possible", "transforms_nerfstudio.json")
        assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize("complete", [True, False])
def test_nerfstudio_gets_all_masks_or_none(tmp_path, complete):
    document = nerfstudio_scene(tmp_path)
    for index, frame in enumerate(document["frames"][0 if complete else 1 :]):
        frame["mask_path"] = f"silhouettes/{index}.png"
        write_image(tmp_path / frame["mask_path"], index, mode="L")
    dataset = read_dataset(save(tmp_path, document))
    write_nerfstudio(refined_set(dataset, dataset.world_from_cam), tmp_path / "t.json", dataset)
    written = json.loads((tmp_path / "t.json").read_text())
    expected = [f["mask_path"] if complete else None for f in document["frames"]]
    assert [frame.get("mask_path") for frame in written["frames"]] == expected
    assert "ply_file_path" not in written


def test_lenses_of_several_kinds_are_told_of():
    mixed = posed_dataset("OPENCV", "OPENCV_FISHEYE")
    [note] = transforms_notes(mixed, mixed.world_from_cam)
    assert "several kinds" in note
    plain = posed_dataset("OPENCV", "PINHOLE")
    assert transforms_notes(plain, plain.world_from_cam) == ()


def llff_folder(folder: Path) -> np.ndarray:
    """Five images with poses_bounds.npy; returns the file's rows."""
    rng = np.random.default_rng(3)
    for i in range(5):
        write_image(folder / f"images/{i}.jpg", i, (64, 48))
    poses = random_poses(rng, 5)[:, :3]
    lens = np.tile([[48.0], [64.0], [70.5]], (5, 1, 1))
    down, right, back, centre = poses[..., 1:2], poses[..., 0:1], -poses[..., 2:3], poses[..., 3:4]
    rows = np.concatenate([down, right, back, centre, lens], axis=2).reshape(5, 15)
    rows = np.column_stack([rows, rng.uniform(1, 2, 5), rng.uniform(5, 9, 5)])
    np.save(folder / "poses_bounds.npy", rows)
    return rows


def test_llff_comes_back_as_its_own_file(tmp_path):
    rows = llff_folder(tmp_path / "in")
    dataset = read_dataset(tmp_path / "in/poses_bounds.npy")
    same = refined_set(dataset, dataset.world_from_cam)
    write_result_formats(same, tmp_path / "same", context=WriteContext(dataset))
    np.testing.assert_allclose(np.load(tmp_path / "same" / LLFF.in_result), rows, atol=1e-12)
    moved = perturb_poses(dataset.world_from_cam, 0.1, 2)
    write_result_formats(refined_set(dataset, moved), tmp_path / "moved", context=WriteContext(dataset))
    read = [
        entry.world_from_cam for entry in parse_llff(tmp_path, tmp_path / "moved" / LLFF.in_result).entries
    ]
    np.testing.assert_allclose(read, moved, atol=1e-12)
    np.testing.assert_array_equal(np.load(tmp_path / "moved" / LLFF.in_result)[:, 14:], rows[:, 14:])


@pytest.mark.parametrize("form", ["tum", "kitti", "bundler"])
def test_trajectories_and_bundles_read_back_from_what_is_written(tmp_path, form):
    folder = tmp_path / "in"
    for i in range(5):
        write_image(folder / f"images/{i}.jpg", i, (64, 48))
    dataset = posed_dataset("SIMPLE_PINHOLE")
    camera = Camera("SIMPLE_PINHOLE", 64, 48, (70.5, 32.0, 24.0))
    frames = tuple(
        replace(f, name=f"{i}.jpg", path=folder / f"images/{i}.jpg", timestamp_s=1e9 + i / 30)
        for i, f in enumerate(dataset.frames[:5])
    )
    dataset = replace(dataset, root=folder / "images", cameras=(camera,), frames=frames)
    write_result_formats(refined_set(dataset, dataset.world_from_cam), tmp_path / "out", ["kitti", "bundler"])
    for name in {
        "tum": ["tum.txt"],
        "kitti": ["kitti.txt"],
        "bundler": ["bundler/bundle.out", "bundler/list.txt"],
    }[form]:
        (folder / Path(name).name).write_bytes((tmp_path / "out" / name).read_bytes())
    (folder / "camera.json").write_text(json.dumps({"w": 64, "h": 48, "fl_x": 70.5, "cx": 32, "cy": 24}))
    again = read_dataset(folder)
    assert again.source.dialect == form
    assert [Path(name).name for name in again.names] == [f"{i}.jpg" for i in range(5)]
    np.testing.assert_allclose(again.world_from_cam, dataset.world_from_cam, atol=1e-9)
    if form == "tum":
        assert [frame.timestamp_s for frame in again.frames] == [frame.timestamp_s for frame in frames]
    assert formats_given_back(again) == {"tum": (), "kitti": ("kitti",), "bundler": ("bundler",)}[form]


def test_a_text_model_comes_back_as_text():
    dataset = posed_dataset("PINHOLE")
    for file_format, given_back in (("text", ("colmap-text",)), ("binary", ())):
        model = replace(random_model(0, rigs=False), file_format=file_format)
        assert (
            formats_given_back(replace(dataset, source=replace(dataset.source, colmap=model))) == given_back
        )


def test_a_file_of_another_name_is_known_by_what_it_begins_with(tmp_path):
    for index in range(3):
        write_image(tmp_path / f"{index}.png", index)
    rows = [
        {"img_name": str(i), "width": WIDTH, "height": HEIGHT, "position": [i, 0, 0], "fx": 18, "fy": 18}
        for i in range(3)
    ]
    turned = [{**row, "rotation": np.eye(3).tolist()} for row in rows]
    assert read_dataset(save(tmp_path, turned, "mine.json")).source.dialect == "gaussian-splatting"
