"""Photos of phones and cameras are read with the colours and the EXIF data that they have, and each once."""

from __future__ import annotations

import struct
import subprocess
import sys
from pathlib import Path

import numpy as np
import pillow_heif
import pytest
from PIL import Image

from biresnerf.data.formats.read_dataset import read_dataset
from biresnerf.data.photos.geotags import read_geotag
from biresnerf.data.photos.guessed_lens import exif_focal_px
from biresnerf.data.photos.image_files import DAMAGED, open_image, quiet_pillow, read_header
from biresnerf.data.photos.images import load_images
from biresnerf.data.photos.kinds.photo_kinds import PHOTO_KINDS
from biresnerf.data.seeding.map_images import lay_out
from biresnerf.errors import InputError
from tests.data.photos.geotagged import geotag
from tests.data.photos.kinds.written import linear, write_dng, write_exr, write_float_tiff, write_hdr
from tests.data.scenes import assert_complete, write_image

WIDTH, HEIGHT = 96, 64
PLACE, FOCAL_35MM = (-33.8568, 151.2153, 4.5), 26


def picture(brightest: int = 230) -> np.ndarray:
    """Smooth colours uint8 [h, w, 3], which neither a mosaic nor a lossy format changes much."""
    y, x = np.mgrid[0:HEIGHT, 0:WIDTH]
    across, down = x / (WIDTH - 1), y / (HEIGHT - 1)
    colour = np.stack([across, down, 0.25 + 0.5 * across * down], axis=2)
    return np.rint(20 + (brightest - 20) * colour).astype(np.uint8)


def tables() -> dict[int, dict]:
    return {0x8769: {0xA405: FOCAL_35MM}, 0x8825: geotag(*PLACE)[0x8825]}


def exif() -> Image.Exif:
    made = Image.Exif()
    for table, values in tables().items():
        made[table] = values
    return made


def write(path: Path, colours: np.ndarray, light: float = 1.0) -> Path:
    """The picture in the kind that its name says, of so much of its light."""
    lit = light * linear(colours / 255)
    if path.suffix == ".heic":
        heif = pillow_heif.from_pillow(Image.fromarray(colours))
        heif.save(path, quality=98, chroma=444, exif=exif().tobytes())
    elif path.suffix == ".avif":
        Image.fromarray(colours).save(path, quality=98, subsampling="4:4:4", exif=exif())
    else:
        writers = {".exr": write_exr, ".tif": write_float_tiff, ".hdr": write_hdr, ".dng": write_dng}
        writers[path.suffix](path, lit, *([tables()] if path.suffix == ".dng" else []))
    return path


def pixels(path: Path) -> np.ndarray:
    with quiet_pillow(), open_image(path, path.name) as image:
        return np.asarray(image)


@pytest.mark.parametrize(
    ("suffix", "near"), [(".heic", 3), (".avif", 4), (".dng", 3), (".exr", 0.6), (".tif", 0.51), (".hdr", 2)]
)
def test_a_set_of_any_kind_has_the_colours_that_were_photographed(tmp_path, suffix, near):
    for i in range(3):
        write(tmp_path / f"IMG_{i}{suffix}", picture(230 - 20 * i))
    dataset = read_dataset(tmp_path)
    images = load_images(dataset)
    assert dataset.names == tuple(f"IMG_{i}{suffix}" for i in range(3))
    for i in range(3):
        # The mosaic is guessed at the borders.
        found, true = images.image(i)[3:-3, 3:-3].astype(float), picture(230 - 20 * i)[3:-3, 3:-3]
        off = np.abs(found - true)
        assert np.quantile(off, 0.99) <= near, (
            i
        )  # of RAW, edges of the mosaic; of HDR, dark colours beside bright ones
        assert off.max() < 10


@pytest.mark.parametrize("suffix", [".heic", ".avif", ".dng"])
def test_focal_length_and_gps_position_are_read(tmp_path, suffix):
    path = write(tmp_path / f"x{suffix}", picture())
    film_diagonal = np.hypot(36, 24)
    expected = FOCAL_35MM * np.hypot(WIDTH, HEIGHT) / film_diagonal
    assert exif_focal_px(read_header(path, "x")) == pytest.approx(expected)
    np.testing.assert_allclose(read_geotag(path, "x").place, PLACE, atol=1e-6)


@pytest.mark.parametrize("suffix", [".nrw", ".PEF", ".kdc"])
def test_a_raw_photo_is_developed_whatever_its_maker_calls_it(tmp_path, suffix):
    for index in range(3):
        write_dng(tmp_path / f"x{index}{suffix}", linear(picture() / 255))
    images = load_images(read_dataset(tmp_path))
    np.testing.assert_allclose(images.image(0)[9:12, 9:12].astype(float), picture()[9:12, 9:12], atol=3)


@pytest.mark.parametrize("orientation", [1, 3, 6, 8])
def test_a_raw_photo_keeps_its_stored_pixels_and_says_how_it_was_held(tmp_path, orientation):
    write_dng(tmp_path / "x.dng", linear(picture() / 255), orientation=orientation)
    header = read_header(tmp_path / "x.dng", "x")
    assert (header.width, header.height, header.orientation) == (WIDTH, HEIGHT, orientation)
    np.testing.assert_allclose(
        pixels(tmp_path / "x.dng")[9:12, 9:12].astype(float), picture()[9:12, 9:12], atol=3
    )


@pytest.mark.parametrize("suffix", [".dng", ".exr", ".tif", ".hdr"])
def test_half_the_light_stays_half_the_light(tmp_path, suffix):
    full = pixels(write(tmp_path / f"full{suffix}", picture()))[16:48, 16:80]
    half = pixels(write(tmp_path / f"half{suffix}", picture(), light=0.5))[16:48, 16:80]
    ratio = linear(half / 255).sum() / linear(full / 255).sum()
    assert ratio == pytest.approx(0.5, abs=0.01)


def test_a_set_whose_white_is_not_one_is_refused_and_says_so(tmp_path):
    write_exr(tmp_path / "x.exr", 400 * linear(picture() / 255))
    with pytest.raises(InputError) as caught, open_image(tmp_path / "x.exr", "x.exr") as image:
        image.load()
    assert_complete(caught.value, "image_format_unsupported", "x.exr")
    assert "1" in caught.value.detail


def test_highlights_and_what_is_no_number_spoil_nothing_else(tmp_path):
    light = linear(picture() / 255)
    light[0, 0], light[0, 1], light[0, 2] = 50.0, np.nan, np.inf
    write_exr(tmp_path / "x.exr", light)
    found = pixels(tmp_path / "x.exr")
    assert found[0, 0].tolist() == [255] * 3
    assert found[0, 1].tolist() == [0] * 3
    assert found[0, 2].tolist() == [255] * 3
    np.testing.assert_allclose(found[1:].astype(float), picture()[1:], atol=0.51)


def test_an_exr_with_opacity_and_a_window_is_what_its_renderer_showed(tmp_path):
    colours, opacity = linear(picture() / 255), np.zeros((HEIGHT, WIDTH, 1))
    opacity[:, : WIDTH // 2] = 0.5
    window = (np.array([-10, -5], np.int32), np.array([WIDTH - 11, HEIGHT - 6], np.int32))
    shown = (np.array([0, 0], np.int32), np.array([WIDTH - 11, HEIGHT + 9], np.int32))
    premultiplied = np.concatenate([colours * opacity, opacity], axis=2)
    write_exr(tmp_path / "x.exr", premultiplied, dataWindow=window, displayWindow=shown)
    found = pixels(tmp_path / "x.exr")
    assert found.shape == (HEIGHT + 10, WIDTH - 10, 4)
    np.testing.assert_allclose(found[:50, :30, :3].astype(float), picture()[5:55, 10:40], atol=0.51)
    assert (found[:50, :30, 3] == 128).all()
    assert (found[HEIGHT:, :, 3] == 0).all()


def test_a_photo_in_two_kinds_counts_once_and_the_report_says_which(tmp_path):
    for i in range(3):
        write_image(tmp_path / f"IMG_{i}.JPG", i)
        write(tmp_path / f"IMG_{i}.heic", picture())
    write(tmp_path / "IMG_8.heic", picture())
    write(tmp_path / "IMG_8.dng", picture())
    write(tmp_path / "IMG_9.dng", picture())
    dataset = read_dataset(tmp_path)
    assert dataset.names == ("IMG_0.JPG", "IMG_1.JPG", "IMG_2.JPG", "IMG_8.heic", "IMG_9.dng")
    (note,) = [line for line in dataset.warnings if "count once" in line]
    assert note.startswith("4 photos")
    assert "IMG_0.heic (IMG_0.JPG is used)" in note


def test_colmap_is_given_what_it_can_read(tmp_path):
    photos = tmp_path / "photos"
    photos.mkdir()
    for i, suffix in enumerate((".heic", ".dng", ".exr")):
        write(photos / f"{i}{suffix}", picture())
    (photos / "0.heic").rename(photos / "3.jpg")  # as some phones' apps name it
    write_image(photos / "4.png", 0, (WIDTH, HEIGHT))
    write_float_tiff(photos / "5.tif", linear(picture() / 255)[..., 0])
    dataset = read_dataset(photos)
    assert len(dataset) == 5
    work = tmp_path / "work"
    work.mkdir()
    lay_out(dataset, work)
    plain = {path.name: path for path in sorted((work / "photos").iterdir())}
    assert [path.suffix for path in plain.values()] == [".png"] * 5
    for name, path in plain.items():
        with Image.open(path, formats=("PNG",)) as image:
            assert image.size == (WIDTH, HEIGHT), name
    assert plain["000003.png"].is_symlink()


WITHOUT = """
import importlib.machinery
import sys

class Shut(importlib.machinery.PathFinder):
    @classmethod
    def find_spec(cls, name, path=None, target=None):
        extra = name.partition(".")[0] in ("pillow_heif", "rawpy", "OpenEXR", "tifffile")
        return None if extra else super().find_spec(name, path, target)

sys.meta_path = [Shut if finder is importlib.machinery.PathFinder else finder for finder in sys.meta_path]
from pathlib import Path
from biresnerf.data.formats.read_dataset import read_dataset
from biresnerf.errors import InputError
try:
    print(*read_dataset(Path(sys.argv[1])).warnings)
except InputError as error:
    print(error.code, error.detail, error.hint)
"""


def in_a_bare_installation(folder: Path) -> str:
    """What reading the folder says where the extra is not installed."""
    command = [sys.executable, "-c", WITHOUT, str(folder)]
    return subprocess.run(command, check=True, capture_output=True, text=True).stdout


def test_without_the_extra_the_message_names_it_and_the_command(tmp_path):
    for name in ("a", "b", "c"):
        write(tmp_path / f"{name}.heic", picture())
    said = in_a_bare_installation(tmp_path)
    assert said.startswith("no_images")
    assert "3 HEIC" in said
    assert "pip install 'biresnerf[photos]'" in said
    write(tmp_path / "d.dng", picture())
    for i in range(3):
        write_image(tmp_path / f"{i}.jpg", i)
    said = in_a_bare_installation(tmp_path)
    assert "3 HEIC files are not read" in said
    assert "1 RAW file is not read" in said
    assert said.count("pip install 'biresnerf[photos]'") == 2
    for i in range(3):
        (tmp_path / f"{i}.jpg").unlink()
        (tmp_path / f"{'abc'[i]}.heic").rename(tmp_path / f"{i}.jpg")
    assert "pip install 'biresnerf[photos]'" in in_a_bare_installation(tmp_path)


@pytest.mark.parametrize("kind", PHOTO_KINDS, ids=lambda kind: kind.name)
def test_no_change_of_bytes_makes_a_photo_fail_otherwise_than_by_an_input_error(tmp_path, kind):
    suffix = next(s for s in kind.suffixes if s in (".heic", ".avif", ".exr", ".hdr", ".dng"))
    whole = write(tmp_path / f"x{suffix}", picture()).read_bytes()
    rng, path = np.random.default_rng(5), tmp_path / f"y{suffix}"
    for trial in range(40):
        broken = bytearray(whole[: rng.integers(1, len(whole))] if trial % 4 == 0 else whole)
        for place in rng.integers(0, min(len(broken), 600), 1 + trial % 5):
            broken[place] = rng.integers(0, 256)
        path.write_bytes(broken)
        try:
            with quiet_pillow(), open_image(path, path.name) as image:
                image.load()
        except (InputError, *DAMAGED):
            pass  # what `decode` turns into an InputError


@pytest.mark.parametrize("suffix", [".dng", ".exr", ".hdr"])
def test_a_photo_that_says_it_is_enormous_is_refused_unread(tmp_path, suffix):
    path = write(tmp_path / f"x{suffix}", picture())
    content = path.read_bytes()
    if suffix == ".hdr":
        content = content.replace(f"-Y {HEIGHT} +X {WIDTH}".encode(), b"-Y 90000 +X 90000")
    elif suffix == ".exr":
        for name in (b"dataWindow", b"displayWindow"):
            head = name + b"\0box2i\0" + struct.pack("<i", 16)
            was, wide = (
                struct.pack("<4i", 0, 0, *corner) for corner in ((WIDTH - 1, HEIGHT - 1), (59_999, 59_999))
            )
            content = content.replace(head + was, head + wide)
    else:
        for tag, was in ((256, WIDTH), (257, HEIGHT)):
            entry = tag.to_bytes(2, "little") + (4).to_bytes(2, "little") + (1).to_bytes(4, "little")
            content = content.replace(
                entry + was.to_bytes(4, "little"), entry + (60_000).to_bytes(4, "little")
            )
    path.write_bytes(content)
    with pytest.raises(InputError) as caught, open_image(path, path.name):
        pass
    # LibRaw does not open a file that is too short for what it says.
    assert caught.value.code == ("not_an_image" if suffix == ".dng" else "image_too_large")
