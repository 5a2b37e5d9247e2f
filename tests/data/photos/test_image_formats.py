"""Every form that a photo may be stored in becomes the same 8-bit colours."""

from __future__ import annotations

import struct
import zlib

import numpy as np
import PIL
import pytest
from PIL import Image

from biresnerf.data.formats.read_dataset import read_dataset
from biresnerf.data.photos.images import load_images
from biresnerf.errors import InputError
from tests.data.scenes import HEIGHT, WIDTH, assert_complete, nerfstudio_scene, save


def noise(seed: int, *shape: int) -> np.ndarray:
    return np.random.default_rng(seed).integers(0, 256, shape, dtype=np.uint8)


def _grey16() -> np.ndarray:
    return np.random.default_rng(0).integers(0, 65536, (HEIGHT, WIDTH), dtype=np.uint16)


@pytest.mark.parametrize("suffix", [".png", ".tif"])
def test_sixteen_bit_grey_keeps_its_full_range(tmp_path, suffix):
    document = nerfstudio_scene(tmp_path)
    grey = _grey16()
    grey[0, :2] = 0, 65535
    Image.fromarray(grey).save(tmp_path / f"images/x{suffix}")
    document["frames"][0]["file_path"] = f"images/x{suffix}"
    image = load_images(read_dataset(save(tmp_path, document))).image(0)
    np.testing.assert_allclose(image[..., 0], grey / 257.0, atol=0.51)
    assert (image[..., 0] == image[..., 2]).all()


YCBCR = pytest.param(
    "YCbCr",
    marks=pytest.mark.skipif(
        int(PIL.__version__.split(".")[0]) < 13,
        reason="Pillow before 13 cannot read a YCbCr TIFF that it wrote",
    ),
)


@pytest.mark.parametrize("mode", ["L", "LA", "P", "1", "CMYK", YCBCR])
def test_other_modes_become_rgb_as_pillow_converts_them(tmp_path, mode):
    document = nerfstudio_scene(tmp_path)
    picture = Image.fromarray(noise(5, HEIGHT, WIDTH, 3)).convert(mode)
    suffix = ".tif" if mode in ("CMYK", "YCbCr") else ".png"
    picture.save(tmp_path / f"images/x{suffix}")
    document["frames"][0]["file_path"] = f"images/x{suffix}"
    image = load_images(read_dataset(save(tmp_path, document))).image(0)
    assert np.array_equal(image, np.asarray(picture.convert("RGB")))


def test_a_palette_with_a_transparent_colour_is_transparent(tmp_path):
    document = nerfstudio_scene(tmp_path)
    picture = Image.new("P", (WIDTH, HEIGHT), 0)
    picture.putpalette([10, 20, 30, 200, 100, 50])
    picture.putpixel((3, 2), 1)
    picture.save(tmp_path / "images/x.png", transparency=0)
    document["frames"][0]["file_path"] = "images/x.png"
    images = load_images(read_dataset(save(tmp_path, document)))
    assert images.image(0)[2, 3].tolist() == [200, 100, 50]
    assert images.image(0)[0, 0].tolist() == [255, 255, 255]
    assert images.alpha_image(1).min() == 255


def test_pictures_of_whole_numbers_of_32_bits_are_refused(tmp_path):
    document = nerfstudio_scene(tmp_path)
    Image.fromarray(np.zeros((HEIGHT, WIDTH), np.int32)).save(tmp_path / "images/x.tif")
    document["frames"][0]["file_path"] = "images/x.tif"
    with pytest.raises(InputError) as caught:
        load_images(read_dataset(save(tmp_path, document)))
    assert_complete(caught.value, "image_format_unsupported", "images/x.tif")


def _png_of_16_bits(pixels: np.ndarray) -> bytes:
    """A PNG of uint16 [h, w, c], which Pillow cannot write."""

    def chunk(kind: bytes, content: bytes) -> bytes:
        return (
            struct.pack(">I", len(content)) + kind + content + struct.pack(">I", zlib.crc32(kind + content))
        )

    height, width, channels = pixels.shape
    kind = {1: 0, 2: 4, 3: 2, 4: 6}[channels]
    rows = b"".join(b"\0" + row.astype(">u2").tobytes() for row in pixels)
    header = struct.pack(">IIBBBBB", width, height, 16, kind, 0, 0, 0)
    chunks = chunk(b"IHDR", header) + chunk(b"IDAT", zlib.compress(rows)) + chunk(b"IEND", b"")
    return b"\x89PNG\r\n\x1a\n" + chunks


def _tiff_of_16_bits(pixels: np.ndarray) -> bytes:
    """An uncompressed little-endian TIFF of uint16 [h, w, 3]."""
    height, width, channels = pixels.shape
    content = pixels.astype("<u2").tobytes()
    bits_at = 8 + len(content)
    tags = [
        *(
            (256, 4, 1, width),
            (257, 4, 1, height),
            (258, 3, channels, bits_at),
            (259, 3, 1, 1),
            (262, 3, 1, 2),
        ),
        *(
            (273, 4, 1, 8),
            (277, 3, 1, channels),
            (278, 4, 1, height),
            (279, 4, 1, len(content)),
            (284, 3, 1, 1),
        ),
    ]
    directory = struct.pack("<H", len(tags)) + b"".join(struct.pack("<HHII", *tag) for tag in tags) + bytes(4)
    bits = struct.pack(f"<{channels}H", *[16] * channels)
    return struct.pack("<2sHI", b"II", 42, bits_at + len(bits)) + content + bits + directory


def _loaded(folder, name: str, content: bytes | None = None):
    """The set whose first photo is the file ``name``, written with ``content`` where given; and the set read."""
    document = nerfstudio_scene(folder)
    if content is not None:
        (folder / name).write_bytes(content)
    document["frames"][0]["file_path"] = name
    dataset = read_dataset(save(folder, document))
    return load_images(dataset), dataset


@pytest.mark.parametrize("form", ["png", "tif"])
def test_sixteen_bit_colour_becomes_eight_bit(tmp_path, form):
    pixels = np.random.default_rng(0).integers(0, 65536, (HEIGHT, WIDTH, 3), dtype=np.uint16)
    content = _png_of_16_bits(pixels) if form == "png" else _tiff_of_16_bits(pixels)
    images, _ = _loaded(tmp_path, f"images/x.{form}", content)
    np.testing.assert_allclose(images.image(0), pixels / 257.0, atol=1.01)


def test_sixteen_bit_transparency_is_composited(tmp_path):
    pixels = np.random.default_rng(0).integers(0, 65536, (HEIGHT, WIDTH, 4), dtype=np.uint16)
    images, _ = _loaded(tmp_path, "images/x.png", _png_of_16_bits(pixels))
    share = pixels[..., 3:] / 65535
    np.testing.assert_allclose(images.image(0), pixels[..., :3] / 257 * share + 255 * (1 - share), atol=2.01)


def test_a_cmyk_jpeg_is_not_taken_for_its_negative(tmp_path):
    colour = (200, 60, 20)
    Image.new("RGB", (WIDTH, HEIGHT), colour).convert("CMYK").save(tmp_path / "x.jpg", quality=95)
    images, _ = _loaded(tmp_path, "x.jpg")
    np.testing.assert_allclose(images.image(0)[5, 5], colour, atol=6)


def test_a_palette_with_a_transparency_for_each_colour_is_composited(tmp_path):
    picture = Image.new("P", (WIDTH, HEIGHT), 0)
    picture.putpalette([10, 20, 30, 200, 100, 50, 0, 0, 0])
    picture.putpixel((3, 2), 1)
    picture.putpixel((4, 2), 2)
    picture.save(tmp_path / "x.png", transparency=bytes([0, 255, 128]))
    images, _ = _loaded(tmp_path, "x.png")
    assert images.image(0)[2, 3].tolist() == [200, 100, 50]
    assert images.image(0)[2, 4].tolist() == [127, 127, 127]
    assert images.image(0)[0, 0].tolist() == [255, 255, 255]


@pytest.mark.parametrize("suffix", [".tif", ".webp", ".png"])
def test_of_several_pages_the_first_is_taken_and_the_user_told(tmp_path, suffix):
    first, second = (Image.fromarray(noise(seed, HEIGHT, WIDTH, 3)) for seed in (1, 2))
    lossless = {"lossless": True} if suffix == ".webp" else {}
    first.save(tmp_path / f"x{suffix}", save_all=True, append_images=[second], **lossless)
    images, dataset = _loaded(tmp_path, f"x{suffix}")
    assert np.array_equal(images.image(0), np.asarray(first))
    assert any(f"x{suffix}" in note and "the first is used" in note for note in dataset.warnings)
