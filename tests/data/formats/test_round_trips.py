"""What is written in a form that is also read comes back: names, poses, and the lens where the form can hold it."""

from __future__ import annotations

import shutil
from pathlib import Path

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from biresnerf.data.formats.colmap.write_binary import write_colmap_binary
from biresnerf.data.formats.colmap.write_text import write_colmap_text
from biresnerf.data.formats.read_dataset import read_dataset
from biresnerf.data.formats.simple.bundler import LENSES, write_bundler
from biresnerf.data.formats.simple.trajectory import write_kitti, write_tum
from biresnerf.data.formats.transforms.instant_ngp import write_transforms_ngp
from biresnerf.data.formats.transforms.write_transforms import write_transforms
from biresnerf.data.model.dataset import Dataset, Frame, SourceFormat
from biresnerf.data.model.refined_set import refined_set
from biresnerf.errors import InputError
from biresnerf.geometry.camera.camera_models import MODEL_PARAMETERS, Camera
from biresnerf.geometry.camera.carried_lenses import SHAPES
from tests.data.formats.random_sets import HEIGHT, WIDTH, random_camera, random_poses
from tests.data.scenes import write_image
from tests.geometry.camera.lenses import BEYOND_OPENCV

NAMES = ("c.png", "a.png", "b/a.png", "d.png")  # neither sorted nor of one folder


@pytest.fixture(scope="module")
def photos(tmp_path_factory) -> Path:
    folder = tmp_path_factory.mktemp("photos")
    for index, name in enumerate(NAMES):
        write_image(folder / "images" / name, index, size=(WIDTH, HEIGHT))
    return folder


def image_set(root: Path, cameras: list[Camera], poses: np.ndarray) -> Dataset:
    frames = tuple(
        Frame(f"images/{name}", root / "images" / name, index % len(cameras), pose, "given")
        for index, (name, pose) in enumerate(zip(NAMES, poses, strict=True))
    )
    return Dataset(root, tuple(cameras), frames, SourceFormat("images", None, {}, np.eye(4)))


def write_as(form: str, dataset: Dataset, poses: np.ndarray, folder: Path) -> Path:
    """Writes the set in one form beside its images; returns what to read."""
    refined = refined_set(dataset, poses)
    if form == "transforms.json":
        write_transforms(dataset, poses, folder / form)
    elif form == "transforms_ngp.json":
        write_transforms_ngp(refined, folder / form)
    elif form == "sparse/0":
        write_colmap_binary(refined.model, folder / form)
    elif form == "sparse_txt/0":
        write_colmap_text(refined.model, folder / form)
    elif form == "bundle.out":
        write_bundler(refined, folder)
    elif form == "tum.txt":
        write_tum(refined, folder / form)
    else:
        write_kitti(refined, folder / form)
    return folder / form


def assert_comes_back(dataset: Dataset, again: Dataset, lens: bool = True) -> None:
    there = {path: index for index, path in enumerate(again.file_names)}
    assert there.keys() == set(dataset.file_names)
    for index, path in enumerate(dataset.file_names):
        frame = again.frames[there[path]]
        np.testing.assert_allclose(frame.world_from_cam, dataset.frames[index].world_from_cam, atol=1e-12)
        if lens:
            before, after = dataset.camera_of(index), again.cameras[frame.camera]
            assert after.full() == before.full()
            assert (after.width, after.height) == (before.width, before.height)


FORMS = ["transforms.json", "transforms_ngp.json", "sparse/0", "sparse_txt/0", "bundle.out"]


@pytest.mark.parametrize("model", MODEL_PARAMETERS)
@pytest.mark.parametrize("form", FORMS)
@settings(max_examples=5, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(seed=st.integers(0, 2**31), several=st.booleans())
def test_lenses_poses_and_names_come_back_where_the_form_can_hold_them(
    tmp_path, photos, model, form, seed, several
):
    rng = np.random.default_rng(seed)
    folder = tmp_path / str(seed)
    shutil.rmtree(folder, ignore_errors=True)
    folder.mkdir()
    (folder / "images").symlink_to(photos / "images")
    cameras = [random_camera(rng, model) for _ in range(2 if several else 1)]
    if form == "bundle.out":
        centred = {"cx": WIDTH / 2, "cy": HEIGHT / 2}
        names = MODEL_PARAMETERS[model]
        cameras = [
            Camera(
                model,
                WIDTH,
                HEIGHT,
                tuple(centred.get(n, v) for n, v in zip(names, camera.params, strict=True)),
            )
            for camera in cameras
        ]
    poses = random_poses(rng, len(NAMES))
    dataset = image_set(folder, cameras, poses)
    too_much = form == "transforms_ngp.json" and model in {*BEYOND_OPENCV, *SHAPES}
    if too_much or (form == "bundle.out" and LENSES.problem(cameras[0])):
        with pytest.raises(InputError) as caught:
            write_as(form, dataset, poses, folder)
        assert caught.value.code == "export_not_possible"
        return
    again = read_dataset(write_as(form, dataset, poses, folder))
    assert_comes_back(dataset, again)
    if form.startswith("sparse"):
        assert {camera.model for camera in again.cameras} == {model}


@pytest.mark.parametrize("form", ["tum.txt", "kitti.txt"])
def test_trajectories_come_back_by_the_names_beside_their_poses(tmp_path, photos, form):
    (tmp_path / "images").symlink_to(photos / "images")
    dataset = image_set(
        tmp_path,
        [Camera("SIMPLE_PINHOLE", WIDTH, HEIGHT, (60.0, 32.0, 24.0))],
        random_poses(np.random.default_rng(3), len(NAMES)),
    )
    again = read_dataset(write_as(form, dataset, dataset.world_from_cam, tmp_path))
    assert_comes_back(dataset, again, lens=False)
