"""COLMAP models with their images: poses, names, cameras, masks, and images that the model lacks."""

from __future__ import annotations

import shutil

import numpy as np
import pytest
from PIL import Image

from biresnerf.data.formats.colmap.write_binary import write_colmap_binary
from biresnerf.data.formats.read_dataset import read_dataset
from biresnerf.data.formats.transforms.write_transforms import write_transforms
from biresnerf.data.model.refined_set import refined_set
from biresnerf.data.photos.masks import load_mask
from biresnerf.errors import InputError
from tests.data.formats.simple import trajectories
from tests.data.formats.simple.trajectories import GIVEN_CAMERA, NAMES, assert_at_truth
from tests.data.scenes import HEIGHT, WIDTH, write_image
from tests.data.test_real_sets import ROOT


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


@pytest.mark.parametrize("names", [NAMES, ("left/a.png", "left/b.png", "right/a.png", "right/b.png")])
def test_images_may_lie_in_the_root_itself_or_in_folders_of_it(tmp_path, names):
    trajectories.colmap_set(tmp_path, names)
    for path in list((tmp_path / "images").iterdir()):
        path.rename(tmp_path / path.name)
    (tmp_path / "images").rmdir()
    dataset = read_dataset(tmp_path)
    assert_at_truth(dataset)
    assert dataset.names == dataset.file_names == names
    assert dataset.warnings == ()


def test_a_model_without_images_is_refused(tmp_path):
    trajectories.colmap_set(tmp_path)
    shutil.rmtree(tmp_path / "images")
    with pytest.raises(InputError) as caught:
        read_dataset(tmp_path)
    assert caught.value.code == "no_images"


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
    assert again.source.colmap.file_format == "binary"
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
