"""The first guess of a lens: EXIF's focal length where it says a possible one, else a normal lens."""

from __future__ import annotations

import math
from pathlib import Path

import pytest
from PIL import Image
from PIL.PngImagePlugin import PngInfo

from biresnerf.data.formats.read_dataset import read_dataset
from biresnerf.data.photos.guessed_lens import exif_focal_px, guess_lens
from biresnerf.data.photos.image_files import FocalPlane, ImageHeader, MakerLens, read_header
from biresnerf.errors import InputError
from tests.data.formats.simple import trajectories
from tests.data.scenes import assert_complete, nerfstudio_scene, save

FULL_FRAME = FocalPlane(6000 / 36, 4000 / 24, 6000, 4000)


def test_50_mm_on_film_fill_a_36_mm_wide_picture():
    header = ImageHeader(3000, 2000, focal_35mm=50.0)
    assert exif_focal_px(header) == pytest.approx(50 / 36 * 3000)
    turned = ImageHeader(2000, 3000, focal_35mm=50.0)
    assert exif_focal_px(turned) == pytest.approx(50 / 36 * 3000)
    # A phone's 4:3 sensor: equal diagonals, not equal widths.
    phone = ImageHeader(4000, 3000, focal_35mm=26.0)
    assert exif_focal_px(phone) == pytest.approx(26 * 5000 / math.hypot(36, 24))


def test_the_sensors_resolution_is_scaled_with_a_resized_picture():
    header = ImageHeader(1500, 1000, focal_mm=35.0, focal_plane=FULL_FRAME)
    assert exif_focal_px(header) == pytest.approx(35 / 36 * 1500)


def test_of_two_that_agree_the_finer_counts_and_of_two_that_do_not_the_film():
    agreeing = ImageHeader(6000, 4000, focal_mm=35.4, focal_35mm=35.0, focal_plane=FULL_FRAME)
    assert exif_focal_px(agreeing) == pytest.approx(35.4 / 36 * 6000)
    wrong = FULL_FRAME._replace(px_per_mm_x=300.0)
    quarrelling = ImageHeader(6000, 4000, focal_mm=35.0, focal_35mm=35.0, focal_plane=wrong)
    assert exif_focal_px(quarrelling) == pytest.approx(35 / 36 * 6000)


@pytest.mark.parametrize("focal", [None, 1.0, 5000.0])
def test_what_no_lens_has_is_not_believed(focal):
    camera, source = guess_lens(ImageHeader(600, 400, focal_35mm=focal))
    assert source == "guessed"
    assert camera.params == (1.2 * 600, 300.0, 200.0, 0.0)


# A Phantom 4 RTK's, as its owner published it.
MEASURED = (3659.78, 3653.17, -7.71, 45.9, -0.269478, 0.115681, -8.75619e-5, -0.000306177, -0.0357628)
DRONE = ImageHeader(5472, 3648, focal_35mm=24.0, maker_lens=MakerLens(5472.0, *MEASURED))


def xmp_of_drone(numbers: str, *more: str) -> bytes:
    said = " ".join((f'drone-dji:DewarpData="{numbers}"', *more))
    return f'<x:xmpmeta xmlns:x="adobe:ns:meta/"><rdf:Description {said}/></x:xmpmeta>'.encode()


def lens_by(tmp_path: Path, xmp: bytes) -> MakerLens | None:
    Image.new("RGB", (60, 40)).save(tmp_path / "drone.jpg", xmp=xmp)
    return read_header(tmp_path / "drone.jpg", "drone.jpg").maker_lens


@pytest.mark.parametrize("middle", ["", 'drone-dji:CalibratedOpticalCenterX="2736.000000"'])
def test_a_drones_photo_has_the_lens_that_its_maker_measured(tmp_path, middle):
    numbers = "2018-03-13;" + ", ".join(map(str, MEASURED))
    found = lens_by(tmp_path, xmp_of_drone(numbers, 'drone-dji:DewarpFlag="0"', middle))
    assert found == MakerLens(5472.0 if middle else 0.0, *MEASURED)


@pytest.mark.parametrize(
    ("numbers", "flag"),
    [
        ("2018-03-13;" + ",".join(map(str, MEASURED)), 1),  # undistorted already
        ("2018-03-13;" + ",".join(map(str, MEASURED[:8])), 0),
        ("2018-03-13;3659.78,nan,0,0,0,0,0,0,0", 0),
        ("", 0),
    ],
    ids=["undistorted", "too few", "not a number", "empty"],
)
def test_other_numbers_of_a_maker_are_no_lens(tmp_path, numbers, flag):
    assert lens_by(tmp_path, xmp_of_drone(numbers, f'drone-dji:DewarpFlag="{flag}"')) is None


def test_the_makers_lens_is_opencvs_about_the_middle_and_scales_with_the_picture():
    camera, source = guess_lens(DRONE)
    assert source == "maker"
    fx, fy, cx, cy, k1, k2, p1, p2, k3 = MEASURED
    full = (fx, fy, 2736 + cx, 1824 + cy, k1, k2, p1, p2, k3, 0.0, 0.0, 0.0)
    assert (camera.model, camera.params) == ("FULL_OPENCV", pytest.approx(full))
    half, _ = guess_lens(DRONE._replace(width=2736, height=1824))
    assert half.params[:4] == pytest.approx([each / 2 for each in full[:4]])
    assert half.params[4:] == camera.params[4:]


@pytest.mark.parametrize(
    "changed",
    [
        {"focal_35mm": 35.0},  # a crop, or a zoom
        {"maker_lens": MakerLens(0.0, 3659.78, 3653.17, 0, 0, -0.9, 0, 0, 0, 0)},  # folds back
        {"maker_lens": MakerLens(0.0, 0.0, 0.0, 0, 0, 0, 0, 0, 0, 0)},
        {"maker_lens": MakerLens(0.0, 3659.78, -3653.17, 0, 0, 0, 0, 0, 0, 0)},
    ],
    ids=["another focal length", "no lens", "zeros", "mirrored"],
)
def test_a_makers_lens_that_cannot_be_the_pictures_is_left_to_exif(changed):
    camera, source = guess_lens(DRONE._replace(**changed))
    assert (camera.model, source) == ("SIMPLE_RADIAL", "exif")


def write_jpeg(path: Path, focal_35mm: int | None) -> None:
    exif = Image.Exif()
    if focal_35mm:
        exif.get_ifd(0x8769)[0xA405] = focal_35mm
    Image.new("RGB", (300, 200), (120, 90, 60)).save(path, exif=exif)


def test_a_folder_has_a_camera_for_each_focal_length_and_says_where_it_comes_from(tmp_path):
    for index, focal in enumerate([28, 28, 50, None]):
        write_jpeg(tmp_path / f"{index}.jpg", focal)
    dataset = read_dataset(tmp_path)
    assert [frame.camera for frame in dataset.frames] == [0, 0, 1, 2]
    assert dataset.intrinsics_sources == ("exif", "exif", "guessed")
    assert [round(c.params[0], 3) for c in dataset.cameras] == [233.333, 416.667, 360.0]


def _set_with_lens(folder: Path, lens: dict[str, float], exif: Image.Exif | None = None) -> Path:
    """Four photos of 80 x 60 px in a circle, whose transforms.json has this lens."""
    document = nerfstudio_scene(folder)
    for key in ("fl_x", "fl_y", "cx", "cy", "w", "h", "k1", "k2", "p1", "p2", "camera_angle_x"):
        document.pop(key, None)
    document |= lens
    for number, frame in enumerate(document["frames"]):
        picture = Image.new("RGB", (80, 60), (number, 9, 9))
        picture.save(folder / frame["file_path"], exif=Image.Exif() if exif is None else exif)
    return save(folder, document)


@pytest.mark.parametrize(
    ("lens", "said"),
    [
        ({"fl_x": 1.27, "fl_y": 0.72, "cx": 0.5, "cy": 0.5}, "share of the photo's width"),
        ({"fl_x": 1.27}, "share of the photo's width"),
        ({"fl_x": 4.3}, "looks like millimetres"),
        ({"fl_x": 28.0, "w": 640, "h": 480}, "angle of view of 170 degrees: it looks like millimetres"),
        ({"camera_angle_x": 2.7}, "angle of view of 155 degrees"),
        ({"fl_x": 90.0, "fl_y": 90.0, "cx": 0.5, "cy": 0.5}, "principal point (0.5, 0.5) lies in the corner"),
        ({"fl_x": 90.0, "fl_y": 1.1}, "angle of view of 176 degrees"),
    ],
)
def test_a_lens_in_other_units_than_pixels_is_refused_by_what_it_looks_like(tmp_path, lens, said):
    with pytest.raises(InputError) as caught:
        read_dataset(_set_with_lens(tmp_path, lens))
    assert_complete(caught.value, "intrinsics_invalid", "transforms.json", "frames[0]")
    assert said in caught.value.detail
    assert "in pixels" in caught.value.hint


def test_the_lens_of_any_format_is_looked_at(tmp_path):
    trajectories.colmap_set(tmp_path, lens="PINHOLE 20 16 0.9 1.1 0.5 0.5")
    with pytest.raises(InputError, match="share of the photo's width") as caught:
        read_dataset(tmp_path)
    assert caught.value.code == "intrinsics_invalid"


@pytest.mark.parametrize(
    ("lens", "said"),
    [
        ({"fl_x": 90.0, "fl_y": 90.0, "cx": 41.0, "cy": 28.0}, None),
        ({"fl_x": 28.0, "cx": 41.0, "cy": 28.0}, None),  # 110 degrees: an action camera's
        ({"fl_x": 30.0, "camera_model": "OPENCV_FISHEYE", "cx": 41.0, "cy": 28.0}, None),
        ({"fl_x": 15.0, "cx": 41.0, "cy": 28.0}, "angle of view of 139 degrees, which few lenses have"),
        ({"fl_x": 5000.0, "cx": 41.0, "cy": 28.0}, "angle of view of 0.917 degrees, which few lenses have"),
    ],
)
def test_an_unusual_lens_is_read_and_said(tmp_path, lens, said):
    warnings = read_dataset(_set_with_lens(tmp_path, lens)).warnings
    assert [text for text in warnings if "focal length" in text] == [
        t for t in warnings if said and said in t
    ]
    assert len(warnings) == (said is not None)


def test_a_focal_length_that_exif_contradicts_is_said(tmp_path):
    exif = Image.Exif()
    exif.get_ifd(0x8769)[0xA405] = 35  # 81 px of 80 x 60
    lens = {"cx": 40.0, "cy": 30.0}
    assert read_dataset(_set_with_lens(tmp_path / "a", lens | {"fl_x": 80.0}, exif)).warnings == ()
    warnings = read_dataset(_set_with_lens(tmp_path / "b", lens | {"fl_x": 35.0}, exif)).warnings
    assert any("given as 35 px, and EXIF says 80.89 px" in text for text in warnings)


XMP = '<x:xmpmeta xmlns:x="adobe:ns:meta/"><rdf:RDF><rdf:Description {}/></rdf:RDF></x:xmpmeta>'
GPANO = XMP.format('GPano:ProjectionType="equirectangular"').encode()


@pytest.mark.parametrize("suffix", [".jpg", ".webp", ".tif", ".png"])
def test_panoramas_are_known_by_their_metadata(tmp_path, suffix):
    text = PngInfo()
    text.add_itxt("XML:com.adobe.xmp", GPANO.decode())
    told = {".tif": {"tiffinfo": {700: GPANO}}, ".png": {"pnginfo": text}}.get(suffix, {"xmp": GPANO})
    for number in range(4):
        Image.new("RGB", (80, 40), (number, 9, 9)).save(tmp_path / f"{number}{suffix}", **told)
    assert [camera.model for camera in read_dataset(tmp_path).cameras] == ["EQUIRECTANGULAR"]


def test_a_part_of_a_panorama_is_refused(tmp_path):
    for number in range(4):
        Image.new("RGB", (90, 40), (number, 9, 9)).save(tmp_path / f"{number}.jpg", xmp=GPANO)
    with pytest.raises(InputError) as caught:
        read_dataset(tmp_path)
    assert_complete(caught.value, "camera_model_unsupported", "0.jpg")
    assert "360 by 180 degrees" in caught.value.hint


def test_photos_of_a_panoramas_shape_are_said(tmp_path):
    for number in range(3):
        Image.new("RGB", (80, 40), (number, 9, 9)).save(tmp_path / f"{number}.jpg")
    assert any("panoramas=all" in text for text in read_dataset(tmp_path).warnings)


def test_a_part_of_a_panorama_among_photos_is_left_out(tmp_path):
    for number in range(4):
        Image.new("RGB", (90, 40), (number, 9, 9)).save(
            tmp_path / f"{number}.jpg", xmp=GPANO if number == 1 else b""
        )
    dataset = read_dataset(tmp_path)
    assert dataset.names == ("0.jpg", "2.jpg", "3.jpg")
    assert any("1.jpg" in text and "no whole panorama" in text for text in dataset.warnings)


def test_views_cut_from_a_panorama_that_kept_its_metadata_are_read_with_their_lens(tmp_path):
    save(tmp_path, nerfstudio_scene(tmp_path))
    for path in (tmp_path / "images").iterdir():
        Image.open(path).save(path, xmp=GPANO)
    assert read_dataset(tmp_path).posed.all()
