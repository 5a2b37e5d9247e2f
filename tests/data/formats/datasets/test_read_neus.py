"""cameras_sphere.npz of NeuS and IDR: projections of the photos in the order of their names."""

from __future__ import annotations

import zipfile

import numpy as np
import pytest

from biresnerf.data.formats.datasets.neus import write_neus
from biresnerf.data.formats.read_dataset import read_dataset, read_poses
from biresnerf.errors import InputError
from tests.data.formats.posed_sets import (
    assert_reads_as,
    renamed,
    result_with_photos,
    write_photos,
    write_plain_photos,
)
from tests.data.formats.random_sets import random_result
from tests.data.scenes import assert_complete, refused_at_once
from tests.data.test_real_sets import ROOT

REAL = ROOT / "interop/06_says_no_images_where_there_are/dtu"
NAMES = ["image/10.png", "image/2.png", "image/1.png", "image/0.png", "image/3.png"]


@pytest.mark.parametrize("model", ["SIMPLE_PINHOLE", "PINHOLE"])
def test_what_is_written_comes_back_in_the_order_of_names(tmp_path, model):
    refined = renamed(random_result(5, model=model), NAMES)
    write_photos(tmp_path, refined)
    write_neus(refined, tmp_path / "cameras_sphere.npz")
    for path in (tmp_path, tmp_path / "cameras_sphere.npz"):
        dataset = read_dataset(path)
        assert_reads_as(dataset, refined, "neus")
        assert list(dataset.file_names) == sorted(NAMES)


def test_a_projection_is_the_same_at_any_scale_and_sign(tmp_path):
    refined = result_with_photos(tmp_path, "PINHOLE")
    write_neus(refined, tmp_path / "cameras.npz")
    with np.load(tmp_path / "cameras.npz") as file:
        matrices = dict(file)
    for number in range(5):
        matrices[f"world_mat_{number}"] *= (-1.0) ** number * 10.0 ** (number - 2)
    np.savez(tmp_path / "cameras.npz", **matrices)
    assert_reads_as(read_dataset(tmp_path), refined, "neus")


def test_fewer_photos_than_cameras_go_by_their_numbers(tmp_path):
    refined = renamed(random_result(5, model="PINHOLE"), [f"image/00{i}.png" for i in range(5)])
    write_photos(tmp_path, refined)
    write_neus(refined, tmp_path / "cameras_sphere.npz")
    (tmp_path / "image/001.png").unlink()
    dataset = read_dataset(tmp_path)
    np.testing.assert_allclose(dataset.world_from_cam, refined.world_from_cam[[0, 2, 3, 4]], atol=1e-9)
    (tmp_path / "image/000.png").rename(tmp_path / "image/first.png")
    with pytest.raises(InputError) as caught:
        read_dataset(tmp_path)
    assert_complete(caught.value, "pose_count_mismatch", "cameras_sphere.npz")


def test_a_bad_matrix_costs_one_image_its_pose(tmp_path):
    refined = result_with_photos(tmp_path, "PINHOLE")
    write_neus(refined, tmp_path / "cameras_sphere.npz")
    with np.load(tmp_path / "cameras_sphere.npz") as file:
        matrices = dict(file)
    for bad, code in ((np.full((4, 4), np.nan), "pose_not_finite"), (np.zeros((4, 4)), "pose_file_invalid")):
        np.savez(tmp_path / "cameras_sphere.npz", **{**matrices, "world_mat_1": bad})
        assert read_dataset(tmp_path).posed.tolist() == [True, False, True, True, True]
        with pytest.raises(InputError) as caught:
            read_dataset(tmp_path, strict=True)
        assert_complete(caught.value, code, "world_mat_1")


@pytest.mark.parametrize(
    ("content", "said"),
    [(b"PK", "zip"), (np.array([None]), "is no array of"), (np.zeros(10**6), "is too long")],
)
def test_files_that_hold_something_else_are_refused_at_once(tmp_path, content, said):
    result_with_photos(tmp_path, "PINHOLE")
    file = tmp_path / "cameras_sphere.npz"
    if isinstance(content, bytes):
        file.write_bytes(content)
    else:
        np.savez_compressed(file, world_mat_0=content)
        assert zipfile.is_zipfile(file)
    error = refused_at_once(lambda: read_dataset(file))
    assert error.code == "pose_file_invalid"
    assert said in error.detail


def test_a_real_file_projects_as_its_matrices_do(tmp_path):
    if not REAL.is_dir():
        pytest.skip("no image set interop: set BIRESNERF_TEST_DATA to the folder that holds it")
    with np.load(REAL / "cameras_sphere.npz") as file:
        matrices = {name: file[name] for name in file if name.startswith("world_mat_") and "inv" not in name}
    (tmp_path / "cameras_sphere.npz").write_bytes((REAL / "cameras_sphere.npz").read_bytes())
    write_plain_photos(tmp_path / "image", [f"{i:06}.png" for i in range(49)], (1600, 1200))
    dataset = read_dataset(tmp_path)
    assert len(dataset) == len(matrices) == len(read_poses(tmp_path)) == 49
    for index, pose in enumerate(dataset.world_from_cam):
        point = pose @ [0.3, -0.2, 4.0, 1.0]
        full = dataset.camera_of(index).full()
        ours = np.array([full.fx * 0.3 / 4 + full.cx, full.fy * -0.2 / 4 + full.cy])
        x, y, z = matrices[f"world_mat_{index}"][:3] @ point
        assert np.abs([x / z + 0.5, y / z + 0.5] - ours).max() < 0.02  # its small skew is left out
