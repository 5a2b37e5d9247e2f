"""A matrix per image: ScanNet, NSVF, 7-Scenes, 3DMatch and MobileBrick, each laid out as its program has it."""

from __future__ import annotations

from pathlib import Path, PurePosixPath

import numpy as np
import pytest

from biresnerf.data.formats.read_dataset import read_dataset, read_poses
from biresnerf.errors import InputError
from biresnerf.geometry.camera.camera_models import Camera
from tests.data.formats.random_sets import random_poses
from tests.data.scenes import HEIGHT, WIDTH, assert_complete, write_image
from tests.data.test_real_sets import ROOT

POSES = random_poses(np.random.default_rng(0), 5)
K = np.array([[18.0, 0, 9.75], [0, 18.5, 7.25], [0, 0, 1]])
# A pixel's coordinates are its indices in these programs: the middle of the first one is (0, 0), here (0.5, 0.5).
LENS = Camera("PINHOLE", WIDTH, HEIGHT, (18.0, 18.5, 10.25, 7.75))


def matrix(path: Path, values: np.ndarray) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    np.savetxt(path, values)


def scannet(folder: Path) -> list[str]:
    four = np.eye(4)
    four[:3, :3] = K
    matrix(folder / "intrinsic/intrinsic_color.txt", four)
    matrix(folder / "intrinsic/intrinsic_depth.txt", 2 * four)
    for i, pose in enumerate(POSES):
        matrix(folder / f"pose/{i * 10}.txt", pose)
        write_image(folder / f"color/{i * 10}.jpg", i)
        write_image(folder / f"depth/{i * 10}.png", i, mode="L")
    return [f"color/{i * 10}.jpg" for i in range(5)]


def nsvf(folder: Path) -> list[str]:
    folder.mkdir(exist_ok=True)
    (folder / "intrinsics.txt").write_text("18.0 9.75 7.25 0.\n0. 0. 0.\n1.\n16 20\n")
    (folder / "bbox.txt").write_text("-1 -1 -1 1 1 1 0.1\n")
    for i, pose in enumerate(POSES):
        matrix(folder / f"pose/0_{i:04}.txt", pose)
        write_image(folder / f"rgb/0_{i:04}.png", i)
    return [f"rgb/0_{i:04}.png" for i in range(5)]


def threedmatch(folder: Path, sequence: str = "") -> list[str]:
    matrix(folder / "camera-intrinsics.txt", K)
    for i, pose in enumerate(POSES):
        matrix(folder / sequence / f"frame-{i:06}.pose.txt", pose)
        write_image(folder / sequence / f"frame-{i:06}.color.png", i)
        write_image(folder / sequence / f"frame-{i:06}.depth.png", i, mode="L")
    return [f"{sequence}frame-{i:06}.color.png" for i in range(5)]


def mobilebrick(folder: Path) -> list[str]:
    for i, pose in enumerate(POSES):
        matrix(folder / f"pose/{i:06}.txt", pose)
        matrix(folder / f"intrinsic/{i:06}.txt", K + np.diag([i, i, 0]))
        write_image(folder / f"image/{i:06}.jpg", i)
        write_image(folder / f"arkit_depth/{i:06}.png", i, mode="L")
    return [f"image/{i:06}.jpg" for i in range(5)]


def nerfplusplus(folder: Path) -> list[str]:
    """A matrix in one line; pixels count from the corner."""
    four = np.eye(4)
    four[:3, :3] = K + np.array([[0, 0, 0.5], [0, 0, 0.5], [0, 0, 0]])
    for i, pose in enumerate(POSES):
        matrix(folder / f"train/pose/{i:04}.txt", pose.reshape(1, 16))
        matrix(folder / f"train/intrinsics/{i:04}.txt", four.reshape(1, 16))
        matrix(folder / f"camera_path/pose/{i:04}.txt", np.eye(4).reshape(1, 16))
        write_image(folder / f"train/rgb/{i:04}.png", i)
    matrix(folder / "test/pose/0007.txt", POSES[0].reshape(1, 16))
    write_image(folder / "test/rgb/0007.png", 7)
    return [f"rgb/{i:04}.png" for i in range(5)]


SETS = {
    "nerfplusplus": nerfplusplus,
    "scannet": scannet,
    "nsvf": nsvf,
    "3dmatch": threedmatch,
    "7scenes": lambda folder: threedmatch(folder, "seq-01/"),
    "mobilebrick": mobilebrick,
}


@pytest.mark.parametrize("name", SETS)
def test_each_image_gets_the_matrix_and_the_lens_of_its_name(tmp_path, name):
    names = SETS[name](tmp_path)
    dataset = read_dataset(tmp_path)
    assert (dataset.source.dialect, list(dataset.file_names)) == ("matrix-files", names)
    np.testing.assert_allclose(dataset.world_from_cam, POSES, atol=1e-12)
    for index in range(5):
        expected = LENS.params
        if name == "nsvf":
            expected = (18.0, 18.0, 10.25, 7.75)
        if name == "mobilebrick":
            expected = (18.0 + index, 18.5 + index, 10.25, 7.75)
        assert dataset.camera_of(index).params == expected


@pytest.mark.parametrize("name", ["scannet", "3dmatch"])
def test_one_of_the_files_stands_for_all(tmp_path, name):
    names = SETS[name](tmp_path)
    one = next(tmp_path.rglob("*pose*/*.txt" if name == "scannet" else "*.pose.txt"))
    assert read_dataset(one).file_names == tuple(names)
    assert len(read_poses(one)) == 5


def test_a_lost_pose_is_left_out_and_named(tmp_path):
    scannet(tmp_path)
    matrix(tmp_path / "pose/10.txt", np.full((4, 4), -np.inf))
    dataset = read_dataset(tmp_path)
    lost = [PurePosixPath(n).name for n, p in zip(dataset.file_names, dataset.posed, strict=True) if not p]
    assert lost == ["10.jpg"]
    assert any("1 of 5 poses cannot be used and are left out: 10.txt" in text for text in dataset.warnings)
    with pytest.raises(InputError) as caught:
        read_dataset(tmp_path, strict=True)
    assert_complete(caught.value, "pose_not_finite", "10.txt")


@pytest.mark.parametrize(
    ("file", "text", "code"),
    [
        ("pose/0.txt", "1 2 3", "pose_file_invalid"),
        ("pose/0.txt", "a " * 16, "pose_file_invalid"),
        ("pose/0.txt", "2 0 0 0 0 2 0 0 0 0 2 0 0 0 0 1", "pose_not_rotation"),
        ("intrinsic/intrinsic_color.txt", "1 2\n3 4", "pose_file_invalid"),
        ("intrinsic/intrinsic_color.txt", "18 5 9\n0 18 8\n0 0 1", "intrinsics_invalid"),
    ],
)
def test_a_bad_file_is_named(tmp_path, file, text, code):
    scannet(tmp_path)
    matrix(tmp_path / "pose/-1.txt", POSES[0])
    (tmp_path / file).write_text(text)
    with pytest.raises(InputError) as caught:
        read_dataset(tmp_path, strict=True)
    assert_complete(caught.value, code, Path(file).name)


def test_texts_that_are_no_matrices_are_left_alone(tmp_path):
    for index in range(3):
        write_image(tmp_path / f"images/{index}.png", index)
    (tmp_path / "pose").mkdir()
    (tmp_path / "pose/0.txt").write_text("0.5 0.5 0.2 0.3\n")  # keypoints of people, say
    assert not read_dataset(tmp_path).posed.any()


def test_real_matrices_are_read_as_their_numbers_say():
    case = ROOT / "interop/05_poses_silently_ignored/7scenes"
    if not case.is_dir():
        pytest.skip("no image set interop: set BIRESNERF_TEST_DATA to the folder that holds it")
    dataset = read_dataset(case)
    assert len(dataset) == 8
    for frame in dataset.frames:
        values = np.loadtxt(case / Path(frame.name).name.replace("color.jpg", "pose.txt"))
        np.testing.assert_allclose(frame.world_from_cam[:3, 3], values[:3, 3])
        np.testing.assert_allclose(frame.world_from_cam[:3, :3], values[:3, :3], atol=1e-4)
