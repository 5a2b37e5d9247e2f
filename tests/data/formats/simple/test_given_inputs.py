"""Poses in the forms of other programs: each set is read at its true poses, with its camera, by its names."""

from __future__ import annotations

import numpy as np
import pytest
from PIL import Image

from biresnerf.data.formats.read_dataset import read_dataset
from biresnerf.data.model.refined_set import refined_set
from biresnerf.errors import InputError
from biresnerf.geometry.camera.camera_models import Camera
from tests.data.formats.simple import trajectories
from tests.data.formats.simple.trajectories import GIVEN_CAMERA, NAMES, assert_at_truth, truth
from tests.data.scenes import HEIGHT, WIDTH, write_image
from tests.data.test_real_sets import ROOT


def test_llff_poses_are_read_in_the_order_of_names_with_the_camera_scaled(tmp_path):
    trajectories.llff_set(tmp_path, size=(4 * WIDTH, 4 * HEIGHT), focal=72.0)
    dataset = read_dataset(tmp_path)
    assert_at_truth(dataset)
    assert dataset.source.dialect == "llff"
    assert dataset.cameras[0].full()[:4] == (18.0, 18.0, 10.0, 8.0)


def test_llff_poses_stored_by_columns_and_in_single_precision_are_read(tmp_path):
    file = trajectories.llff_set(tmp_path)
    rows = np.load(file)
    np.save(file, np.asfortranarray(rows))
    assert_at_truth(read_dataset(tmp_path))
    np.save(file, rows.astype(np.float32))
    np.testing.assert_allclose(read_dataset(tmp_path).world_from_cam, truth(), atol=1e-5)


@pytest.mark.parametrize("name", ["fern", "horns"])
def test_llff_poses_of_real_sets_are_those_of_their_transforms_file(tmp_path, name):
    if not (ROOT / name).is_dir():
        pytest.skip(f"no image set {name}: set BIRESNERF_TEST_DATA to the folder that holds it")
    (tmp_path / "images").symlink_to(ROOT / name / "images")
    (tmp_path / "poses_bounds.npy").symlink_to(ROOT / name / "poses_bounds.npy")
    dataset, other = read_dataset(tmp_path), read_dataset(ROOT / name)
    assert [f"images/{frame.name}" for frame in dataset.frames] == list(other.names)
    np.testing.assert_allclose(dataset.world_from_cam, other.world_from_cam, atol=1e-6)
    np.testing.assert_allclose(dataset.cameras[0].full()[:4], other.cameras[0].full()[:4], rtol=1e-9)


TIMES = ["1305031102.1753", "1305031102.2112", "1305031102.2431", "1305031102.2753"]


@pytest.mark.parametrize(
    ("times", "names", "said"),
    [
        (["0", "1", "2", "3"], NAMES, "by number, in the order"),
        (["0", "1", "2", "3"], ("001.png", "002.png", "003.png", "004.png"), "by number, in the order"),
        (["1", "2", "3", "4"], ("001.png", "002.png", "003.png", "004.png"), "by time (by the images' names"),
        (TIMES, tuple(f"{time}.png" for time in TIMES), "by time (by the images' names"),
        (TIMES, NAMES, "in the order of the images' names"),
    ],
)
def test_a_tum_trajectory_is_matched_by_time_or_number_or_order_and_says_how(tmp_path, times, names, said):
    trajectories.tum_set(tmp_path, times, names)
    dataset = read_dataset(tmp_path)
    assert_at_truth(dataset)
    assert dataset.names == names
    assert dataset.cameras == (Camera("OPENCV", WIDTH, HEIGHT, (18.0, 18.5, 10.25, 7.75, 0.01, 0, 0, 0)),)
    assert said in dataset.warnings[0]
    assert [frame.timestamp_s for frame in dataset.frames] == [float(time) for time in times]
    assert dataset.source.dialect == "tum"
    assert refined_set(dataset, dataset.world_from_cam).timestamps_s == tuple(map(float, times))


EUROC_NS = [1403636579763555584 + 50_000_000 * index for index in range(4)]


@pytest.mark.parametrize(
    ("times", "names"),
    [
        (TIMES, [f"rgb_{time}.png" for time in TIMES]),
        (TIMES, [f"cam0_{time}_left.png" for time in TIMES]),
        ([f"{ns / 1e9:.9f}" for ns in EUROC_NS], [f"{ns}.png" for ns in EUROC_NS]),
        ([f"{ns / 1e9:.9f}" for ns in EUROC_NS], [f"{ns // 1000}.png" for ns in EUROC_NS]),
        ([f"{ns / 1e9:.9f}" for ns in EUROC_NS], [f"{ns // 10**6}.png" for ns in EUROC_NS]),
        ([f"{ns / 1e9:.9f}" for ns in EUROC_NS], [f"{ns // 10**9}_{ns % 10**9:09}.png" for ns in EUROC_NS]),
        ([f"{ns}.000000" for ns in EUROC_NS], [f"frame-{ns}.png" for ns in EUROC_NS]),
        ([f"{ns}" for ns in EUROC_NS], [f"{ns / 1e9:.6f}.png" for ns in EUROC_NS]),
        (["12.345", "12.445", "12.545", "12.645"], ["12346.png", "12446.png", "12546.png", "12646.png"]),
    ],
)
def test_times_in_names_are_matched_in_any_unit_and_behind_any_prefix(tmp_path, times, names):
    # One photo more than there are poses: order decides nothing.
    trajectories.tum_set(tmp_path, list(times), tuple(names))
    write_image(tmp_path / "images/zz_without_time.png", 9)
    dataset = read_dataset(tmp_path)
    assert dataset.posed.tolist() == [True, True, True, True, False]
    np.testing.assert_allclose([f.world_from_cam for f in dataset.frames[:4]], truth(), atol=1e-12)
    assert "by time (by the images' names" in dataset.warnings[0]


def test_numbers_that_count_photos_are_no_times(tmp_path):
    names = tuple(f"frame_{number}.png" for number in range(4))
    trajectories.tum_set(tmp_path, ["0.0", "0.5", "1.0", "1.5"], names)
    dataset = read_dataset(tmp_path)
    assert_at_truth(dataset)
    assert "in the order of the images' names" in dataset.warnings[0]


def test_keyframes_of_mast3r_slam_find_their_photos_by_number_at_its_rate(tmp_path):
    frames = [0, 7, 19, 30]
    trajectories.tum_set(tmp_path, [str(np.float32(frame / 30)) for frame in frames], ())
    for frame in range(31):
        write_image(tmp_path / f"images/frame_{frame + 1}.png", frame)
    dataset = read_dataset(tmp_path / "trajectory.txt")
    posed = {frame.name: frame.world_from_cam for frame in dataset.frames if frame.world_from_cam is not None}
    assert list(posed) == [f"frame_{frame + 1}.png" for frame in frames]
    np.testing.assert_allclose(list(posed.values()), truth(), atol=1e-12)
    assert "30 images a second" in dataset.warnings[0]


def test_a_trajectorys_own_comments_and_rgb_txt_go_before_the_order(tmp_path):
    names = tuple(reversed(NAMES))
    head = "".join(f"# {time} {name}\n" for time, name in zip(TIMES, names, strict=True))
    trajectories.tum_set(tmp_path / "commented", TIMES, head=head)
    trajectories.tum_set(tmp_path / "listed", TIMES)
    late = [f"{float(time) + 0.004:.4f}" for time in TIMES]
    (tmp_path / "listed/rgb.txt").write_text("# t name\n" + head.replace("# ", "").replace(TIMES[0], late[0]))
    for folder, said in (("commented", "names in its comments"), ("listed", "by rgb.txt")):
        dataset = read_dataset(tmp_path / folder)
        assert_at_truth(dataset, truth()[::-1])
        assert said in dataset.warnings[0]


def test_tums_own_layout_is_read_and_its_table_of_times_belongs_to_it(tmp_path):
    (tmp_path / "groundtruth.txt").write_text("\n".join(trajectories.tum_lines(TIMES)))
    table = []
    for index, (time, name) in enumerate(zip(TIMES, NAMES, strict=True)):
        write_image(tmp_path / "rgb" / name, index)
        write_image(tmp_path / "depth" / name, index)
        table.append(f"{time} rgb/{name}")
    (tmp_path / "rgb.txt").write_text("\n".join(reversed(table)))
    dataset = read_dataset(tmp_path)
    assert_at_truth(dataset)
    assert list(dataset.file_names) == [f"rgb/{name}" for name in NAMES]
    assert [path.name for path in dataset.source.files] == ["groundtruth.txt", "rgb.txt"]
    write_image(tmp_path / "left" / NAMES[0], 0)
    assert_at_truth(read_dataset(tmp_path))  # rgb/ is what photos are called
    (tmp_path / "rgb").rename(tmp_path / "first")
    with pytest.raises(InputError, match=r"first/, left/, and which are meant is not clear"):
        read_dataset(tmp_path)


def test_images_without_a_pose_near_in_time_have_none(tmp_path):
    names = (*(f"{time}.png" for time in TIMES[:3]), "1305031109.0.png")
    trajectories.tum_set(tmp_path, TIMES, names)
    dataset = read_dataset(tmp_path)
    assert dataset.posed.tolist() == [True, True, True, False]
    np.testing.assert_allclose(dataset.frames[1].world_from_cam, truth()[1], atol=1e-12)


@pytest.mark.parametrize(
    ("name", "text", "camera"),
    [
        (
            "cameras.txt",
            "1 RADIAL 20 16 18 10 8 0.01 0.002\n",
            Camera("RADIAL", 20, 16, (18.0, 10, 8, 0.01, 0.002)),
        ),
        ("calib.txt", "P0: 18 0 10.25 0 0 18.5 7.75 0 0 0 1 0\n", GIVEN_CAMERA),
    ],
)
def test_a_trajectorys_camera_may_be_colmaps_or_kittis(tmp_path, name, text, camera):
    trajectories.tum_set(tmp_path, ["0", "1", "2", "3"])
    (tmp_path / "camera.json").unlink()
    (tmp_path / name).write_text(text)
    assert read_dataset(tmp_path).cameras == (camera,)


def test_a_trajectory_without_camera_gets_a_guess_and_says_so(tmp_path):
    trajectories.tum_set(tmp_path, ["0", "1", "2", "3"])
    (tmp_path / "camera.json").unlink()
    dataset = read_dataset(tmp_path)
    assert dataset.intrinsics_sources == ("guessed",)
    assert any("focal length is a guess" in text for text in dataset.warnings)
    exif = Image.Exif()
    exif.get_ifd(0x8769)[0xA405] = 50  # mm on 35 mm film
    for name in NAMES:
        picture = Image.open(tmp_path / "images" / name)
        (tmp_path / "images" / name).unlink()
        picture.save(tmp_path / "images" / name.replace("png", "jpg"), exif=exif)
    dataset = read_dataset(tmp_path)
    assert dataset.intrinsics_sources == ("exif",)
    assert any("is taken from EXIF" in text for text in dataset.warnings)
    assert not any("is a guess" in text for text in dataset.warnings)


def test_positions_and_quaternions_without_times_are_read_in_order(tmp_path):
    file = trajectories.tum_set(tmp_path, ["0", "1", "2", "3"])
    file.unlink()
    lines = [line.partition(" ")[2] for line in trajectories.tum_lines(["0", "1", "2", "3"])]
    (tmp_path / "pose.txt").write_text("\n".join(lines))
    dataset = read_dataset(tmp_path)
    assert_at_truth(dataset)
    assert "in the order of the images' names" in dataset.warnings[0]
    assert [frame.timestamp_s for frame in dataset.frames] == [None] * 4


def test_a_file_called_pose_that_holds_none_is_no_trajectory(tmp_path):
    trajectories.write_images(tmp_path)
    (tmp_path / "pose.txt").write_text("look to the left\n")
    assert not read_dataset(tmp_path).posed.any()


def test_kitti_poses_are_read_in_order_with_the_projection_of_their_camera(tmp_path):
    trajectories.kitti_set(tmp_path)
    dataset = read_dataset(tmp_path)
    assert_at_truth(dataset)
    assert dataset.cameras == (GIVEN_CAMERA,)
    assert dataset.source.dialect == "kitti"


@pytest.mark.parametrize("listed", [True, False])
def test_a_bundle_file_is_read_with_its_list_or_in_order(tmp_path, listed):
    trajectories.bundler_set(tmp_path, listed)
    dataset = read_dataset(tmp_path)
    assert_at_truth(dataset)
    assert dataset.cameras == (Camera("RADIAL", WIDTH, HEIGHT, (18.5, 10.0, 8.0, 0.01, -0.002)),)
    assert dataset.file_names == tuple(f"images/{name}" for name in NAMES)
    assert any("in the order of their names" in text for text in dataset.warnings) == (not listed)


def test_a_bundlers_camera_of_focal_length_zero_has_no_pose(tmp_path):
    trajectories.bundler_set(tmp_path, unposed=2)
    assert read_dataset(tmp_path).posed.tolist() == [True, True, False, True]


def test_a_metashape_export_is_read_by_its_labels(tmp_path):
    trajectories.write_images(tmp_path)
    (tmp_path / "cameras.xml").write_text(
        trajectories.metashape_xml("<k1>0.01</k1><p1>0.001</p1><b1>-0.5</b1>")
    )
    dataset = read_dataset(tmp_path)
    assert_at_truth(dataset)
    assert dataset.names == NAMES
    # Metashape's p1 is COLMAP's p2.
    assert dataset.cameras == (Camera("OPENCV", 20, 16, (18.0, 18.5, 10.25, 7.75, 0.01, 0.0, 0.0, 0.001)),)


def test_metashapes_third_radial_term_makes_the_camera_full_opencv(tmp_path):
    trajectories.write_images(tmp_path)
    (tmp_path / "cameras.xml").write_text(trajectories.metashape_xml("<k1>0.01</k1><k3>0.001</k3>"))
    camera = read_dataset(tmp_path).cameras[0]
    assert (camera.model, camera.params[4:]) == ("FULL_OPENCV", (0.01, 0, 0, 0, 0.001, 0, 0, 0))


def test_metashapes_tangential_terms_move_a_point_as_its_manual_says(tmp_path):
    import torch

    from biresnerf.geometry.camera.camera import Intrinsics, project

    p1, p2, x, y = 0.02, -0.01, 0.3, -0.2
    trajectories.write_images(tmp_path)
    (tmp_path / "cameras.xml").write_text(trajectories.metashape_xml(f"<p1>{p1}</p1><p2>{p2}</p2>"))
    intrinsics = Intrinsics.from_cameras(read_dataset(tmp_path).cameras)
    point = torch.tensor([[x, y, 1.0]], dtype=torch.float64)
    pixel = project(intrinsics, torch.zeros(1, dtype=torch.long), point)[0].tolist()
    r2 = x * x + y * y
    moved = (x + p1 * (r2 + 2 * x * x) + 2 * p2 * x * y, y + p2 * (r2 + 2 * y * y) + 2 * p1 * x * y)
    assert pixel == pytest.approx([10.25 + 18.5 * moved[0], 7.75 + 18.5 * moved[1]], abs=1e-5)


def test_kittis_colour_camera_is_placed_beside_the_one_that_its_poses_are_of(tmp_path):
    trajectories.kitti_set(tmp_path)
    (tmp_path / "poses.txt").rename(tmp_path / "07.txt")
    (tmp_path / "images").rename(tmp_path / "image_2")
    write_image(tmp_path / "image_3/0.png")
    left = "P0: 18 0 10.25 0 0 18.5 7.75 0 0 0 1 0\n"
    # P2 = K [I | t]: camera 2 lies half a unit to the left of camera 0, and 0.1 behind it.
    (tmp_path / "calib.txt").write_text(
        left + f"P2: 20 0 11 {20 * 0.5 + 11 * 0.1} 0 20 7 {7 * 0.1} 0 0 1 0.1\n"
    )
    dataset = read_dataset(tmp_path)
    expected = truth()
    expected[:, :3, 3] -= expected[:, :3, :3] @ [0.5, 0.0, 0.1]
    assert_at_truth(dataset, expected)
    assert dataset.cameras == (Camera("PINHOLE", WIDTH, HEIGHT, (20.0, 20.0, 11.0, 7.0)),)


def test_a_header_of_a_trajectory_without_a_mark_is_read_over(tmp_path):
    file = trajectories.tum_set(tmp_path, ["0", "1", "2", "3"])
    file.write_text("timestamp tx ty tz qx qy qz qw\n" + file.read_text())
    assert_at_truth(read_dataset(tmp_path))
