"""`biresnerf convert`: a round trip keeps poses and names."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
from click.testing import CliRunner, Result
from hypothesis import given, settings
from hypothesis import strategies as st

from biresnerf.commands.poses.convert import convert_command
from biresnerf.data.formats.colmap.read_model import read_colmap_model
from biresnerf.data.formats.read_dataset import read_dataset
from biresnerf.data.formats.simple.poses_json import matrix_of, read_poses_json
from biresnerf.data.model.dataset import Dataset
from biresnerf.errors import InputError
from biresnerf.geometry.camera.camera_models import MODEL_PARAMETERS
from biresnerf.options.formats import formats
from tests.data.formats.random_sets import random_poses
from tests.data.formats.simple import trajectories
from tests.data.scenes import write_image

OPENCV_FROM_OPENGL = np.diag([1.0, -1.0, -1.0, 1.0])
# Not read again here: pinhole has photos of its own, csv no lenses, and the others are only written.
WRITTEN_ONLY = ("pinhole", "poses", "csv", "scene", "points")
FORMS = {name: one for name, one in formats().items() if one.in_set}
# Where each form is written that is read again.
PLACES = {name: one.in_set for name, one in FORMS.items() if name not in WRITTEN_ONLY}
BOUNDS = ("--bounds", 0.5, 9)  # for sets without points


def run(*arguments: object) -> Result:
    return CliRunner().invoke(convert_command, [str(a) for a in arguments])


def converted(*arguments: object) -> dict:
    result = run(*arguments, "--json")
    assert result.exit_code == 0, (result.output, result.exception)
    return json.loads(result.stdout)


def by_file(dataset: Dataset) -> dict[str, np.ndarray]:
    return {
        Path(name).name: pose for name, pose in zip(dataset.file_names, dataset.world_from_cam, strict=True)
    }


def assert_same(found: Dataset, given: Dataset) -> None:
    ours, theirs = by_file(found), by_file(given)
    assert len(ours) == len(found.frames)
    assert set(ours) == set(theirs)
    for name, pose in theirs.items():
        np.testing.assert_allclose(ours[name], pose, rtol=0, atol=1e-9, err_msg=name)


def write_set(folder: Path, seed: int, count: int, k1: float = 0.01) -> None:
    poses = random_poses(np.random.default_rng(seed), count)
    photos = "images" if seed % 2 else "train"
    frames = []
    for index, pose in enumerate(poses):
        name = f"{(7 * index + 5) % 13}.png"  # the file's order is not that of names
        write_image(folder / photos / name, index)
        frames.append(
            {"file_path": f"{photos}/{name}", "transform_matrix": (pose @ OPENCV_FROM_OPENGL).tolist()}
        )
    lens = {"fl_x": 18.0, "fl_y": 18.0, "cx": 10.0, "cy": 8.0, "w": 20, "h": 16, "k1": k1}
    (folder / "transforms.json").write_text(json.dumps({"camera_model": "OPENCV", **lens, "frames": frames}))


@pytest.mark.parametrize("form", PLACES)
@settings(max_examples=5, deadline=None)
@given(seed=st.integers(0, 2**31), count=st.integers(3, 6))
def test_there_and_back_keeps_poses_and_names(tmp_path_factory, form: str, seed: int, count: int) -> None:
    folder = tmp_path_factory.mktemp("set")
    write_set(folder / "given", seed, count, 0.0 if "distortion" in FORMS[form].loses else 0.01)
    given_set = read_dataset(folder / "given")
    there = converted(folder / "given", folder / "there", "--to", form, *(BOUNDS if form == "llff" else ()))
    assert there["formats"] == {form: str(folder / "there" / PLACES[form])}
    between = read_dataset(folder / "there" / PLACES[form])
    assert_same(between, given_set)
    converted(folder / "there" / PLACES[form], folder / "back", "--to", "transforms")
    back = read_dataset(folder / "back")
    assert_same(back, given_set)
    if form in (
        "transforms",
        "nerfstudio",
        "instant-ngp",
        "bundler",
    ):  # the others are read in the order of names
        assert list(back.file_names) == list(given_set.file_names)


@pytest.mark.parametrize("form", trajectories.FORMS)
def test_every_form_that_is_read_becomes_every_form_that_is_written(tmp_path: Path, form: str) -> None:
    scene = tmp_path / "scene"
    trajectories.write_set(form, scene)
    given_set = read_dataset(scene)
    # Bundler knows one focal length, in the middle of the image; LLFF that without distortion; no points are read.
    fitting = {"bundler": ("llff", "bundler"), "llff": ("llff",), "points": ()}
    fitting |= dict.fromkeys(("meshroom", "openmvg", "realitycapture"), ("llff", "bundler", "metashape"))
    fitting["neus"] = ("llff", "kitti")
    forms = [name for name in FORMS if form in fitting.get(name, (form,))]
    wanted = [word for name in forms for word in ("--to", name)]
    done = converted(scene, tmp_path / "all", *wanted, "--photos", "copy")
    assert list(done["formats"]) == forms
    assert done["images"] == 4
    for place in (PLACES[name] for name in forms if name in PLACES):
        assert_same(read_dataset(tmp_path / "all" / place), given_set)
    poses = read_poses_json(tmp_path / "all" / "poses.json")
    for image, pose in zip(poses.images, given_set.world_from_cam, strict=True):
        np.testing.assert_allclose(matrix_of(image.world_from_cam), pose, rtol=0, atol=1e-9)
    assert len(read_colmap_model(tmp_path / "all" / "pinhole/sparse/0").images) == 4
    assert (tmp_path / "all" / "scene.glb").read_bytes()[:4] == b"glTF"
    assert not any(path.is_symlink() for path in (tmp_path / "all").rglob("*"))


@pytest.mark.parametrize("form", PLACES)
def test_the_folder_that_was_written_is_read_with_its_poses(tmp_path: Path, form: str) -> None:
    write_set(tmp_path / "given", seed=1, count=4, k1=0.0)
    converted(tmp_path / "given", tmp_path / "there", "--to", form, *(BOUNDS if form == "llff" else ()))
    assert_same(read_dataset(tmp_path / "there"), read_dataset(tmp_path / "given"))


def test_the_command_offers_every_form_there_is() -> None:
    [option] = [one for one in convert_command.params if one.name == "names"]
    assert set(option.type.choices) == set(FORMS)


def test_a_form_that_cannot_hold_the_set_leaves_nothing_behind(tmp_path: Path) -> None:
    trajectories.tum_set(tmp_path / "scene", ["0", "1", "2", "3"])
    refused = run(tmp_path / "scene", tmp_path / "out", "--to", "tum", "--to", "points")
    assert isinstance(refused.exception, InputError)
    assert refused.exception.code == "export_not_possible"
    assert [path.name for path in tmp_path.iterdir()] == ["scene"]


def test_images_without_a_pose_are_left_out_and_named(tmp_path: Path) -> None:
    trajectories.colmap_set(tmp_path / "scene", registered=3)
    result = run(tmp_path / "scene", tmp_path / "out", "--to", "transforms")
    assert result.exit_code == 0, result.output
    assert "left out, without a pose: " in result.stderr
    assert "d.png" in result.stderr
    assert len(json.loads((tmp_path / "out/transforms.json").read_text())["frames"]) == 3


def test_masks_that_another_form_would_not_find_are_told_of(tmp_path: Path) -> None:
    write_set(tmp_path / "scene", seed=1, count=4)
    file = tmp_path / "scene" / "transforms.json"
    document = json.loads(file.read_text())
    for index, frame in enumerate(document["frames"]):
        frame["mask_path"] = f"silhouettes/{index}.png"
        write_image(tmp_path / "scene" / frame["mask_path"], index, mode="L")
    file.write_text(json.dumps(document))
    named = converted(tmp_path / "scene", tmp_path / "named", "--to", "transforms")
    assert named["warnings"] == ["masks were found for 4 of 4 images"]
    assert all(frame.mask is not None for frame in read_dataset(tmp_path / "named").frames)
    lost = converted(tmp_path / "scene", tmp_path / "lost", "--to", "colmap", "--to", "pinhole")
    assert [w for w in lost["warnings"] if "colmap names no masks: 4 of them" in w]
    assert [w for w in lost["warnings"] if "pinhole has no masks" in w]
    assert not any(frame.mask for frame in read_dataset(tmp_path / "lost" / "sparse/0").frames)


def test_photos_alone_and_a_folder_with_files_are_refused(tmp_path: Path) -> None:
    trajectories.write_images(tmp_path / "photos")
    nothing = run(tmp_path / "photos", tmp_path / "out", "--to", "tum")
    assert isinstance(nothing.exception, InputError)
    assert nothing.exception.code == "no_poses"
    trajectories.colmap_set(tmp_path / "scene")
    full = run(tmp_path / "scene", tmp_path / "scene", "--to", "tum")
    assert isinstance(full.exception, InputError)
    assert full.exception.code == "output_not_empty"


def test_llff_has_the_bounds_of_the_points_that_each_image_sees_unless_they_are_given(tmp_path: Path) -> None:
    write_set(tmp_path / "bare", seed=1, count=4, k1=0.0)
    missing = run(tmp_path / "bare", tmp_path / "out", "--to", "llff")
    assert isinstance(missing.exception, InputError)
    assert missing.exception.code == "bounds_missing"
    converted(tmp_path / "bare", tmp_path / "given", "--to", "llff", *BOUNDS)
    rows = np.load(tmp_path / "given" / "poses_bounds.npy")
    np.testing.assert_array_equal(rows[:, 15:], np.tile([0.5, 9.0], (4, 1)))
    # An input of that form keeps its own.
    converted(tmp_path / "given", tmp_path / "kept", "--to", "llff")
    kept = np.load(tmp_path / "kept" / "poses_bounds.npy")
    np.testing.assert_allclose(kept, rows, rtol=0, atol=1e-12)
    np.testing.assert_array_equal(kept[:, 15:], rows[:, 15:])
    assert run(tmp_path / "given", tmp_path / "no", "--to", "llff", "--bounds", 2, 1).exit_code == 2


def test_a_distorted_lens_is_not_written_where_distortion_cannot_be(tmp_path: Path) -> None:
    write_set(tmp_path / "scene", seed=1, count=4)
    refused = run(tmp_path / "scene", tmp_path / "out", "--to", "llff", *BOUNDS)
    assert isinstance(refused.exception, InputError)
    assert "it is distorted" in str(refused.exception)


@pytest.mark.parametrize("form", ["colmap", "colmap-text", "transforms"])
@pytest.mark.parametrize(
    "shape", [{"FOV": (0.9,)}, {"DIVISION": (-0.2,)}, {"EUCM": (0.6, 1.1)}], ids=["FOV", "DIVISION", "EUCM"]
)
def test_a_lens_of_another_formula_is_kept_to_the_bit(
    tmp_path: Path, form: str, shape: dict[str, tuple[float, ...]]
) -> None:
    write_set(tmp_path / "given", seed=1, count=4)
    path = tmp_path / "given" / "transforms.json"
    document = json.loads(path.read_text())
    del document["k1"]
    [(model, values)] = shape.items()
    named = dict(zip(MODEL_PARAMETERS[model][4:], values, strict=True))
    path.write_text(json.dumps(document | named | {"camera_model": model, "fl_y": 18.1}))
    converted(tmp_path / "given", tmp_path / "model", "--to", "colmap")
    converted(tmp_path / "model" / PLACES["colmap"], tmp_path / "there", "--to", form)
    converted(tmp_path / "there" / PLACES[form], tmp_path / "back", "--to", "colmap")
    [camera] = read_colmap_model(tmp_path / "back" / "sparse" / "0").cameras.values()
    assert (camera.model, camera.params) == (model, (18.0, 18.1, 10.0, 8.0, *values))
