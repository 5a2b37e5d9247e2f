"""Poses and lenses of VGGT, Depth Anything 3, DUSt3R and MASt3R, traced back from scaled pictures to the photos."""

from __future__ import annotations

import numpy as np
import pytest
from PIL import Image
from scipy.spatial.transform import Rotation

from biresnerf.data.formats.read_dataset import read_dataset
from biresnerf.data.photos.guessed_lens import with_shared_predictions
from biresnerf.errors import InputError
from tests.data.formats.posed_sets import write_plain_photos
from tests.data.formats.predicted import programs
from tests.data.scenes import assert_complete

NAMES = ["images/b.png", "images/a.png", "images/d.png", "images/c.png"]
SIZES = {
    "landscape": [(1200, 800)] * 4,
    "portrait": [(810, 1203)] * 4,
    "odd": [(1013, 761)] * 4,
    "wide": [(1500, 500)] * 4,
    "square": [(900, 900)] * 4,
    "mixed": [(1200, 800), (1200, 800), (800, 1200), (1210, 1001)],
}
ERROR_PX = 0.05


def true_poses(count=4, seed=5):
    rng = np.random.default_rng(seed)
    poses = np.tile(np.eye(4), (count, 1, 1))
    poses[:, :3, :3] = Rotation.random(count, random_state=seed).as_matrix()
    poses[:, :3, 3] = rng.normal(size=(count, 3))
    return poses


def true_lens(size):
    return (0.9 * max(size), 0.9 * max(size), size[0] / 2 + 3.0, size[1] / 2 - 2.0)


def assert_true(dataset, sizes, focal_alone=False):
    """Names in the order in which programs list them have the true poses, and the lenses of the photos."""
    assert list(dataset.file_names) == sorted(NAMES)
    np.testing.assert_allclose(dataset.world_from_cam, true_poses(), atol=1e-6)
    assert set(dataset.intrinsics_sources) == {"predicted"}
    for row, size in enumerate(sizes):
        full, truth = dataset.camera_of(row).full(), true_lens(size)
        assert (dataset.camera_of(row).width, dataset.camera_of(row).height) == size
        np.testing.assert_allclose(
            (full.fx, full.fy), truth[:2], rtol=3e-3 if focal_alone else 0, atol=ERROR_PX
        )
        centre = (size[0] / 2, size[1] / 2) if focal_alone else truth[2:]
        np.testing.assert_allclose((full.cx, full.cy), centre, atol=1.5 if focal_alone else ERROR_PX)


def predicted(folder, sizes, process, together=lambda pictures: pictures):
    """The photos of the names in text order, and what a program sees of each: its channels and intrinsic matrix."""
    for name, size in zip(sorted(NAMES), sizes, strict=True):
        write_plain_photos(folder, [name], size)
    pictures = together([process(programs.coordinates(size)) for size in sizes])
    lenses = [
        programs.lens_of_picture(one, true_lens(size)) for one, size in zip(pictures, sizes, strict=True)
    ]
    return pictures, np.stack(lenses).astype(np.float32)


def cam_from_world():
    return np.linalg.inv(true_poses())[:, :3].astype(np.float32)


@pytest.mark.parametrize("sizes", SIZES.values(), ids=SIZES)
@pytest.mark.parametrize(("way", "margin"), [("crop", 1.0), ("pad", 1.0), ("square", 0.0)])
def test_vggts_predictions_are_traced_back_to_the_photos(tmp_path, way, margin, sizes):
    together = programs.vggt_together if way == "crop" else lambda pictures: pictures
    pictures, lenses = predicted(tmp_path, sizes, getattr(programs, f"vggt_{way}"), together)
    images = np.stack([programs.as_colours(one, margin) for one in pictures])
    arrays = {"extrinsic": cam_from_world(), "intrinsic": lenses, "images": images}
    np.savez(tmp_path / "predictions.npz", depth=images[:, :1].transpose(0, 2, 3, 1), **arrays)
    dataset = read_dataset(tmp_path)
    assert_true(dataset, sizes)
    assert any("in the order of their names" in note for note in dataset.warnings)
    assert any("what a network predicted" in note for note in dataset.warnings)


@pytest.mark.parametrize("sizes", SIZES.values(), ids=SIZES)
@pytest.mark.parametrize(
    "place", ["exports/npz/results.npz", "exports/mini_npz/results.npz", "predictions.npz"]
)
def test_depth_anythings_exports_are_traced_back_to_the_photos(tmp_path, place, sizes):
    pictures, lenses = predicted(tmp_path, sizes, programs.da3_resize, programs.da3_together)
    file = tmp_path / place
    file.parent.mkdir(parents=True, exist_ok=True)
    depth = np.stack([one[0] for one in pictures]).astype(np.float32)
    np.savez_compressed(file, depth=depth, extrinsics=cam_from_world(), intrinsics=lenses)
    for path in (tmp_path, file):
        assert_true(read_dataset(path), sizes)


@pytest.mark.parametrize("sizes", SIZES.values(), ids=SIZES)
@pytest.mark.parametrize("size", [512, 224])
def test_what_people_save_of_dust3r_is_traced_back_to_the_photos(tmp_path, size, sizes):
    _, lenses = predicted(tmp_path, sizes, lambda photo: programs.dust3r(photo, size))
    poses = true_poses().astype(np.float32)
    np.savez(tmp_path / "poses.npz", poses=poses, intrinsics=lenses)
    assert_true(read_dataset(tmp_path), sizes)
    np.savez(tmp_path / "poses.npz", cams2world=poses, focals=lenses[:, [0, 1], [0, 1]], pps=lenses[:, :2, 2])
    assert_true(read_dataset(tmp_path), sizes)
    (tmp_path / "poses.npz").unlink()
    if size == 512:
        np.save(tmp_path / "poses.npy", poses)
        np.save(tmp_path / "focals.npy", lenses[:, :1, 0])
        assert_true(read_dataset(tmp_path), sizes, focal_alone=True)


def test_dust3rs_photos_are_those_that_exif_turns_and_vggts_those_stored(tmp_path):
    exif = Image.Exif()
    exif[0x0112] = 6
    (tmp_path / "images").mkdir()
    for name in NAMES:
        Image.new("L", (1200, 800)).save(tmp_path / name, exif=exif)
    upright = np.stack(
        [programs.lens_of_picture(programs.dust3r(programs.coordinates((800, 1200))), true_lens((800, 1200)))]
        * 4
    )
    np.savez(tmp_path / "poses.npz", poses=true_poses(), intrinsics=upright)
    assert_true(read_dataset(tmp_path), [(800, 1200)] * 4)
    (tmp_path / "poses.npz").unlink()
    stored = np.stack(
        [
            programs.lens_of_picture(
                programs.vggt_crop(programs.coordinates((1200, 800))), true_lens((1200, 800))
            )
        ]
        * 4
    )
    depth = np.zeros((4, 350, 518, 1), np.float32)
    np.savez(tmp_path / "predictions.npz", extrinsic=cam_from_world(), intrinsic=stored, depth=depth)
    assert_true(read_dataset(tmp_path), [(1200, 800)] * 4)


def test_photos_of_one_lens_share_the_median_of_what_was_predicted_for_each(tmp_path):
    _, lenses = predicted(tmp_path, SIZES["landscape"], programs.vggt_crop)
    spread = np.array([0.95, 1.0, 1.02, 1.3])
    lenses[:, [0, 1], [0, 1]] *= spread[:, None]
    depth = np.zeros((4, 350, 518), np.float32)
    np.savez(tmp_path / "predictions.npz", extrinsic=cam_from_world(), intrinsic=lenses, depth=depth)
    dataset = read_dataset(tmp_path)
    assert len(dataset.cameras) == 4
    (camera,) = with_shared_predictions(dataset).cameras
    assert camera.model == "SIMPLE_RADIAL"
    assert camera.full().fx == pytest.approx(np.median(spread) * true_lens((1200, 800))[0], abs=ERROR_PX)
    lenses[3, [0, 1], [0, 1]] *= 2.0  # a zoom
    np.savez(tmp_path / "predictions.npz", extrinsic=cam_from_world(), intrinsic=lenses, depth=depth)
    assert len(with_shared_predictions(read_dataset(tmp_path)).cameras) == 4


@pytest.mark.parametrize("images", [np.zeros((4, 3), np.float32), np.zeros((4, 3, 350, 518), np.uint8)])
def test_pictures_in_another_form_say_nothing_of_margins(tmp_path, images):
    _, lenses = predicted(tmp_path, SIZES["landscape"], programs.vggt_crop)
    arrays = {"extrinsic": cam_from_world(), "intrinsic": lenses, "images": images}
    np.savez(tmp_path / "predictions.npz", depth=np.zeros((4, 350, 518)), **arrays)
    assert_true(read_dataset(tmp_path), SIZES["landscape"])
    np.savez(tmp_path / "predictions.npz", **{**arrays, "intrinsic": lenses[:, 0]})
    with pytest.raises(InputError) as caught:
        read_dataset(tmp_path)
    assert_complete(caught.value, "pose_file_invalid", "predictions.npz intrinsic")


def test_a_file_without_lenses_or_with_fewer_photos_is_refused_by_name(tmp_path):
    _, lenses = predicted(tmp_path, SIZES["landscape"], programs.da3_resize)
    np.savez(tmp_path / "results.npz", extrinsics=cam_from_world(), depth=np.zeros((4, 336, 504)))
    with pytest.raises(InputError) as caught:
        read_dataset(tmp_path / "results.npz")
    assert_complete(caught.value, "pose_file_invalid", "results.npz")
    arrays = {"depth": np.zeros((4, 336, 504)), "intrinsics": lenses}
    np.savez(tmp_path / "results.npz", extrinsics=cam_from_world()[:3], **arrays)
    with pytest.raises(InputError):
        read_dataset(tmp_path / "results.npz")
    np.savez(tmp_path / "results.npz", extrinsics=cam_from_world(), **arrays)
    (tmp_path / NAMES[0]).unlink()
    with pytest.raises(InputError) as caught:
        read_dataset(tmp_path)
    assert_complete(caught.value, "pose_count_mismatch", "results.npz")


def write_model(folder, sizes):
    """sparse/ as VGGT and Depth Anything 3 write it: a PINHOLE camera each, and pixels of depth maps for points."""
    (folder / "sparse").mkdir()
    cameras, images, points = [], [], []
    for row, (name, size, pose) in enumerate(
        zip(sorted(NAMES), sizes, cam_from_world().astype(float), strict=True), 1
    ):
        write_plain_photos(folder, [name], size)
        cameras.append(" ".join(map(str, [row, "PINHOLE", *size, *true_lens(size)])))
        x, y, z, w = Rotation.from_matrix(pose[:, :3]).as_quat()
        images.append(" ".join(map(str, [row, w, x, y, z, *pose[:, 3], row, name.removeprefix("images/")])))
        images.append(" ".join(f"{10 * k}.0 5.0 {3 * row + k}" for k in range(3)))
        for k in range(3):
            points.append(f"{3 * row + k} 0 0 {k} 1 2 3 0 {row} {k}")
    for table, lines in (("cameras", cameras), ("images", images), ("points3D", points)):
        (folder / f"sparse/{table}.txt").write_text("\n".join(lines))


def test_lenses_of_a_model_whose_points_one_photo_sees_each_are_predictions(tmp_path):
    write_model(tmp_path, SIZES["mixed"])
    dataset = read_dataset(tmp_path)
    assert_true(dataset, SIZES["mixed"])
    assert any("each point of the model is seen by one photo" in note for note in dataset.warnings)
    shared = with_shared_predictions(dataset)
    assert [frame.camera for frame in shared.frames] == [0, 0, 1, 2]


def test_a_model_of_matches_has_given_lenses(tmp_path):
    write_model(tmp_path, SIZES["landscape"])
    file = tmp_path / "sparse/points3D.txt"
    lines = file.read_text().splitlines()
    images = (tmp_path / "sparse/images.txt").read_text().splitlines()
    second = images[3].split()
    second[2] = lines[0].split()[0]  # the first photo's first point, seen by the second, too
    images[3] = " ".join(second)
    lines[0] += " 2 0"
    del lines[3]
    file.write_text("\n".join(lines))
    (tmp_path / "sparse/images.txt").write_text("\n".join(images))
    assert read_dataset(tmp_path).intrinsics_sources == ()
