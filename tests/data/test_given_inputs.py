"""Poses in the forms of other programs: each set is read at its true poses, with its camera, by its names."""

from __future__ import annotations

import numpy as np
import pytest
from PIL import Image

from biresnerf.data.dataset import Camera
from biresnerf.data.masks import load_mask
from biresnerf.data.packs.colmap_binary import write_colmap_binary
from biresnerf.data.read import read_dataset
from biresnerf.data.refined_set import refined_set
from biresnerf.data.write import write_transforms
from biresnerf.errors import InputError
from tests.data import trajectories
from tests.data.scenes import HEIGHT, WIDTH, write_image
from tests.data.test_real_sets import ROOT
from tests.data.trajectories import NAMES, truth

GIVEN_CAMERA = Camera("PINHOLE", WIDTH, HEIGHT, (18.0, 18.5, 10.25, 7.75))


def assert_at_truth(dataset, poses=None):
    poses = truth() if poses is None else poses
    assert dataset.posed.all()
    np.testing.assert_allclose(dataset.world_from_cam, poses, atol=1e-12)
    assert {frame.pose_source for frame in dataset.frames} == {"given"}


def test_a_colmap_model_is_read_with_its_images_by_name(tmp_path):
    model = trajectories.colmap_set(tmp_path)
    for path in (tmp_path, model, model / "images.txt"):
        dataset = read_dataset(path)
        assert_at_truth(dataset)
        assert dataset.names == NAMES
        assert dataset.root == tmp_path
        assert dataset.file_names == tuple(f"images/{name}" for name in NAMES)
        assert dataset.cameras == (GIVEN_CAMERA,)
        assert dataset.intrinsics_sources == ()
        assert dataset.source.dialect == "colmap"
        assert dataset.source.colmap.images.keys() == {1, 2, 3, 4}
        assert dataset.warnings == ()


@pytest.mark.parametrize("place", ["colmap/sparse/0", "sparse", ".", "sparse_txt/0"])
def test_a_model_is_found_wherever_programs_put_it(tmp_path, place):
    scene = tmp_path / "scene"
    model = trajectories.colmap_set(scene)
    (scene / place).mkdir(parents=True, exist_ok=True)
    for file in list(model.iterdir()):
        file.rename(scene / place / file.name)
    for path in (scene, scene / place):
        dataset = read_dataset(path)
        assert_at_truth(dataset)
        assert dataset.file_names[0] == "images/a.png"


def test_images_that_a_model_has_not_registered_become_frames_without_pose(tmp_path):
    trajectories.colmap_set(tmp_path, registered=3)
    dataset = read_dataset(tmp_path)
    assert dataset.names == NAMES
    assert dataset.posed.tolist() == [True, True, True, False]
    assert dataset.frames[3].pose_source is None
    assert dataset.camera_of(3) == GIVEN_CAMERA  # the only one that took images of this shape
    assert "1 of 4 images have no pose yet: d.png" in dataset.warnings


def test_an_image_of_a_shape_that_no_camera_took_gets_a_guess_and_says_so(tmp_path):
    trajectories.colmap_set(tmp_path, registered=3)
    write_image(tmp_path / "images/d.png", size=(40, 16))
    dataset = read_dataset(tmp_path)
    assert dataset.intrinsics_sources == ("given", "guessed")
    assert any("focal length is a guess" in text for text in dataset.warnings)


def test_images_of_another_size_get_the_models_camera_scaled(tmp_path):
    trajectories.colmap_set(tmp_path, lens="PINHOLE 40 32 36 37 20.5 15.5")
    dataset = read_dataset(tmp_path)
    assert dataset.cameras == (GIVEN_CAMERA,)
    assert any("were scaled to the images" in text for text in dataset.warnings)
    assert dataset.source.colmap.cameras == {1: GIVEN_CAMERA}


def test_features_are_scaled_with_the_camera_so_that_they_still_see_their_points(tmp_path):
    """Real features and points: the error of reprojection, in the images' own pixels, shrinks as the images did."""
    folder = ROOT / "lund_door"
    if not folder.is_dir():
        pytest.skip("no image set lund_door: set BIRESNERF_TEST_DATA to the folder that holds it")
    (tmp_path / "images").symlink_to(folder / "images")
    (tmp_path / "sparse").symlink_to(folder / "colmap_sparse_fullres")
    dataset = read_dataset(tmp_path)
    model = dataset.source.colmap
    frame = dataset.frames[3]
    image = next(image for image in model.images.values() if image.name == frame.name)
    seen = image.point3d_ids >= 0
    row_of_id = {number: row for row, number in enumerate(model.points.ids.tolist())}
    points = model.points.xyz[[row_of_id[number] for number in image.point3d_ids[seen].tolist()]]
    in_cam = (points - frame.world_from_cam[:3, 3]) @ frame.world_from_cam[:3, :3]
    f, cx, cy, k1 = model.cameras[image.camera_id].params
    plane = in_cam[:, :2] / in_cam[:, 2:]
    pixels = f * plane * (1 + k1 * (plane**2).sum(1, keepdims=True)) + [cx, cy]
    off = np.linalg.norm(pixels - image.points2d_px[seen], axis=1)
    assert np.median(off) < 0.5
    assert (image.points2d_px.max(axis=0) < [648, 968]).all()


def test_images_of_one_camera_in_two_sizes_are_refused(tmp_path):
    trajectories.colmap_set(tmp_path)
    write_image(tmp_path / "images/c.png", size=(2 * WIDTH, 2 * HEIGHT))
    with pytest.raises(InputError) as caught:
        read_dataset(tmp_path)
    assert caught.value.code == "mixed_sizes"


def test_equal_cameras_of_different_ids_stay_apart(tmp_path):
    model = trajectories.colmap_set(tmp_path)
    cameras, images = model / "cameras.txt", model / "images.txt"
    cameras.write_text(cameras.read_text() + cameras.read_text().replace("1 PINHOLE", "2 PINHOLE"))
    images.write_text(images.read_text().replace(" 1 d.png", " 2 d.png"))
    dataset = read_dataset(tmp_path)
    assert dataset.cameras == (GIVEN_CAMERA, GIVEN_CAMERA)
    assert [frame.camera for frame in dataset.frames] == [0, 0, 0, 1]


@pytest.mark.parametrize(
    ("change", "said"),
    [
        (lambda name: f"left/{name}", "by file name alone (a.png is left/a.png)"),
        (str.upper, "by file name, whatever its case (a.png is A.PNG)"),
        (lambda name: name.replace(".png", ".jpg"), "by file name without extension (a.png is a.jpg)"),
    ],
)
def test_images_under_other_names_are_found_where_just_one_can_be_meant_and_it_is_said(
    tmp_path, change, said
):
    trajectories.colmap_set(tmp_path)
    for name in NAMES:
        (tmp_path / "images" / name).unlink()
        write_image(tmp_path / "images" / change(name))
    dataset = read_dataset(tmp_path)
    assert_at_truth(dataset)
    assert dataset.names == NAMES
    assert dataset.warnings == (f"4 images were found {said}",)


def test_names_with_backslashes_or_composed_otherwise_are_found(tmp_path):
    trajectories.colmap_set(tmp_path, ("left\\a.png", "b\u00e4.png", "c.png", "d.png"))
    for path in list((tmp_path / "images").iterdir()):
        path.unlink()
    for name in ("left/a.png", "ba\u0308.png", "c.png", "d.png"):
        write_image(tmp_path / "images" / name)
    dataset = read_dataset(tmp_path)
    assert dataset.file_names == ("images/ba\u0308.png", "images/c.png", "images/d.png", "images/left/a.png")
    assert len(dataset.warnings) == 1
    assert "another Unicode form" in dataset.warnings[0]


def test_names_that_hold_the_folder_of_images_are_taken_from_the_root(tmp_path):
    trajectories.colmap_set(tmp_path)
    text = tmp_path / "sparse/0/images.txt"
    for name in NAMES:
        text.write_text(text.read_text().replace(f" {name}", f" images/{name}"))
    dataset = read_dataset(tmp_path)
    assert dataset.names == dataset.file_names == tuple(f"images/{name}" for name in NAMES)
    assert dataset.warnings == ()


def test_a_colmap_set_written_back_has_the_models_names_and_a_transforms_file_that_finds_the_images(tmp_path):
    trajectories.colmap_set(tmp_path)
    dataset = read_dataset(tmp_path)
    write_transforms(dataset, dataset.world_from_cam, tmp_path / "transforms.json")
    again = read_dataset(tmp_path)
    assert again.source.dialect == "nerfstudio"
    assert_at_truth(again)
    (tmp_path / "transforms.json").unlink()
    write_colmap_binary(refined_set(dataset, dataset.world_from_cam).model, tmp_path / "sparse/0")
    again = read_dataset(tmp_path)
    assert again.source.colmap.form == "binary"
    assert again.names == NAMES
    assert_at_truth(again)


@pytest.mark.parametrize("names", [NAMES, ("x/a.png", "x/b.png", "y/a.png", "y/b.png")])
def test_colmaps_masks_and_instant_ngps_are_found(tmp_path, names):
    trajectories.colmap_set(tmp_path, names)
    write_image(tmp_path / f"masks/{names[0]}.png", mode="L")
    other = tmp_path / "images" / names[1]
    write_image(other.with_name(f"dynamic_mask_{other.stem}.png"), mode="L")
    dataset = read_dataset(tmp_path)
    assert dataset.names == names  # a mask is no image
    assert [(frame.mask is not None, frame.mask_inverted) for frame in dataset.frames] == [
        (True, False), (True, True), (False, False), (False, False),
    ]  # fmt: skip


def test_a_stored_photo_that_its_camera_means_turned_is_turned(tmp_path):
    trajectories.colmap_set(tmp_path)
    exif = Image.Exif()
    exif[0x0112] = 6
    Image.new("RGB", (HEIGHT, WIDTH)).save(tmp_path / "images/a.png", exif=exif)
    dataset = read_dataset(tmp_path)
    assert [frame.orientation for frame in dataset.frames] == [6, 1, 1, 1]
    assert dataset.cameras == (GIVEN_CAMERA,)


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


@pytest.mark.parametrize(
    ("model", "count", "posed", "names"),
    [("kitchen25/sparse", 25, 23, "{:02}.jpg"), ("lund_door/colmap_sparse_fullres", 12, 12, "DSC_{:04}.JPG")],
)
def test_models_of_real_sets_have_the_poses_of_their_transforms_file(tmp_path, model, count, posed, names):
    folder = ROOT / model.split("/")[0]
    if not folder.is_dir():
        pytest.skip(f"no image set {folder.name}: set BIRESNERF_TEST_DATA to the folder that holds it")
    (tmp_path / "images").symlink_to(folder / "images")
    (tmp_path / "sparse").symlink_to(ROOT / model)
    dataset, other = read_dataset(tmp_path), read_dataset(folder)
    assert (len(dataset), int(dataset.posed.sum())) == (count, posed)
    first = 1 if "DSC" in names else 0
    assert dataset.names == tuple(names.format(i + first) for i in range(count))
    true = {
        name.split("/")[-1].casefold(): pose
        for name, pose in zip(other.names, other.world_from_cam, strict=True)
    }
    for frame in dataset.frames:
        if frame.world_from_cam is not None:
            np.testing.assert_allclose(frame.world_from_cam, true[frame.name.casefold()], atol=2e-5)
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


def test_a_mask_of_another_shape_is_refused_when_the_set_is_read(tmp_path):
    trajectories.colmap_set(tmp_path)
    write_image(tmp_path / "masks/b.png.png", size=(WIDTH, 2 * HEIGHT), mode="L")
    with pytest.raises(InputError) as caught:
        read_dataset(tmp_path)
    assert caught.value.code == "mask_size_mismatch"


def test_instant_ngps_mask_means_the_opposite_of_colmaps(tmp_path):
    trajectories.colmap_set(tmp_path)
    picture = np.zeros((HEIGHT, WIDTH), np.uint8)
    picture[:4] = 255
    (tmp_path / "masks").mkdir()
    Image.fromarray(picture).save(tmp_path / "masks/a.png.png")
    Image.fromarray(picture).save(tmp_path / "images/dynamic_mask_b.png")
    dataset = read_dataset(tmp_path)
    white_counts, black_counts = (load_mask(dataset.frames[i], dataset.camera_of(i)) for i in range(2))
    np.testing.assert_array_equal(white_counts, picture > 0)
    np.testing.assert_array_equal(black_counts, picture == 0)


def test_metashapes_tangential_terms_move_a_point_as_its_manual_says(tmp_path):
    import torch

    from biresnerf.geometry.camera import Intrinsics, project

    p1, p2, x, y = 0.02, -0.01, 0.3, -0.2
    trajectories.write_images(tmp_path)
    (tmp_path / "cameras.xml").write_text(trajectories.metashape_xml(f"<p1>{p1}</p1><p2>{p2}</p2>"))
    intrinsics = Intrinsics.from_cameras(read_dataset(tmp_path).cameras)
    point = torch.tensor([[x, y, 1.0]], dtype=torch.float64)
    pixel = project(intrinsics, torch.zeros(1, dtype=torch.long), point)[0].tolist()
    r2 = x * x + y * y
    moved = (x + p1 * (r2 + 2 * x * x) + 2 * p2 * x * y, y + p2 * (r2 + 2 * y * y) + 2 * p1 * x * y)
    assert pixel == pytest.approx([10.25 + 18.5 * moved[0], 7.75 + 18.5 * moved[1]], abs=1e-5)
