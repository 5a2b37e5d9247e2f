"""Decoding: every stored form becomes the right bytes, at the right size, over the right background."""

from __future__ import annotations

import threading
import time

import numpy as np
import pytest
from PIL import Image

from biresnerf.data.formats.read_dataset import read_dataset
from biresnerf.data.photos.decode import decode
from biresnerf.data.photos.images import load_by_content, load_images, uniform_background, working_size
from biresnerf.errors import InputError, Interrupted
from tests.data.scenes import (
    HEIGHT,
    WIDTH,
    assert_complete,
    blender_scene,
    nerfstudio_scene,
    save,
    write_image,
)


def png_scene(folder, values: list[np.ndarray], **top):
    """A scene of the given pictures, stored as PNG."""
    document = nerfstudio_scene(folder, count=len(values), **top)
    for index, (picture, row) in enumerate(zip(values, document["frames"], strict=True)):
        row["file_path"] = f"images/{index:03}.png"
        Image.fromarray(picture).save(folder / row["file_path"])
        (folder / f"images/{index:03}.jpg").unlink()
    return read_dataset(save(folder, document))


def square_scene(folder, pictures: list[np.ndarray]):
    """A scene of square pictures, whatever their size."""
    side = len(pictures[0])
    lens = {"w": side, "h": side, "fl_x": 1.2 * side, "fl_y": 1.2 * side, "cx": side / 2, "cy": side / 2}
    return png_scene(folder, pictures, **lens)


def noise(seed: int, *shape: int) -> np.ndarray:
    return np.random.default_rng(seed).integers(0, 256, shape, dtype=np.uint8)


def test_full_size_images_are_the_stored_bytes_in_order(tmp_path):
    pictures = [noise(index, HEIGHT, WIDTH, 3) for index in range(4)]
    images = load_images(png_scene(tmp_path, pictures))
    assert images.alpha is None
    assert images.pixels.dtype == np.uint8
    assert images.offsets.tolist() == [0, 320, 640, 960, 1280]
    for index, picture in enumerate(pictures):
        assert np.array_equal(images.image(index), picture)


def test_images_of_mixed_sizes_lie_one_after_another(tmp_path):
    document = nerfstudio_scene(tmp_path)
    sizes = [(20, 16), (10, 30), (7, 5), (40, 20)]
    for index, (row, size) in enumerate(zip(document["frames"], sizes, strict=True)):
        row["file_path"] = f"images/m{index}.png"
        write_image(tmp_path / row["file_path"], index, size)
        row |= {"w": size[0], "h": size[1], "fl_x": 20.0, "fl_y": 20.0, "cx": size[0] / 2, "cy": size[1] / 2}
    images = load_images(read_dataset(save(tmp_path, document)), max_size=20)
    assert list(zip(images.widths.tolist(), images.heights.tolist(), strict=True)) == [
        (20, 16),
        (7, 20),
        (7, 5),
        (20, 10),
    ]
    assert images.pixels.shape == (320 + 140 + 35 + 200, 3)
    stored = np.asarray(Image.open(tmp_path / "images/m2.png"))
    assert np.array_equal(images.image(2), stored)
    halves = np.asarray(Image.open(tmp_path / "images/m3.png")).astype(float).reshape(10, 2, 20, 2, 3)
    np.testing.assert_allclose(images.image(3), halves.mean(axis=(1, 3)), atol=0.51)
    some = images.of(np.array([3, 0]))
    assert some.cameras == (images.cameras[3], images.cameras[0])
    for i, index in enumerate((3, 0)):
        np.testing.assert_array_equal(some.image(i), images.image(index))


def test_cameras_follow_the_true_ratios(tmp_path):
    images = load_images(read_dataset(save(tmp_path, nerfstudio_scene(tmp_path))), max_size=7)
    assert (images.widths[0], images.heights[0]) == (7, 6)
    full = images.cameras[0].full()
    assert full[:4] == pytest.approx((18 * 7 / 20, 18.5 * 6 / 16, 10.25 * 7 / 20, 7.75 * 6 / 16))
    assert (images.cameras[0].width, images.cameras[0].height) == (7, 6)


def test_working_sizes_never_grow_and_never_vanish():
    assert working_size(20, 10, None) == (20, 10)
    assert working_size(20, 10, 100) == (20, 10)
    assert working_size(1000, 3, 100) == (100, 1)


def test_transparency_is_composited_and_kept(tmp_path):
    pictures = [noise(index, HEIGHT, WIDTH, 4) for index in range(3)]
    dataset = png_scene(tmp_path, pictures)
    for background, behind in (("auto", 255.0), ("white", 255.0), ("black", 0.0)):
        images = load_images(dataset, background=background)
        share = pictures[1][..., 3:] / 255.0
        expected = pictures[1][..., :3] * share + (1 - share) * behind
        np.testing.assert_allclose(images.image(1), expected, atol=0.51)
        assert np.array_equal(images.alpha_image(1), pictures[1][..., 3])
        assert images.background.tolist() == [behind / 255] * 3
    images = load_images(dataset, background="none")
    assert np.array_equal(images.image(1), pictures[1][..., :3])
    assert images.alpha is None
    assert images.background is None


def test_hidden_colours_do_not_bleed_into_shrunk_edges(tmp_path):
    picture = np.zeros((HEIGHT, WIDTH, 4), dtype=np.uint8)
    picture[:, :9] = (200, 100, 50, 255)
    picture[:, 9:] = (0, 255, 0, 0)  # bright green that nobody is to see
    images = load_images(png_scene(tmp_path, [picture] * 3), max_size=10)
    half = images.image(0)[0, 4]  # one column of paint, one of nothing: half paint over white
    np.testing.assert_allclose(half, (np.array([200, 100, 50]) + 255) / 2, atol=0.51)
    assert images.alpha_image(0)[0].tolist() == [255] * 4 + [128] + [0] * 5


def test_opaque_rgba_counts_as_opaque(tmp_path):
    picture = noise(0, HEIGHT, WIDTH, 4)
    picture[..., 3] = 255
    images = load_images(png_scene(tmp_path, [picture] * 3))
    assert images.alpha is None
    assert images.background is None


def test_blender_images_lie_over_white(tmp_path):
    images = load_images(read_dataset(save(tmp_path, blender_scene(tmp_path))))
    assert images.alpha is not None
    assert images.background.tolist() == [1.0, 1.0, 1.0]


@pytest.mark.parametrize("suffix", [".png", ".jpg", ".webp", ".tif", ".bmp"])
@pytest.mark.parametrize("kept", [0.5, 0.9])
def test_cut_off_images_are_refused_by_name(tmp_path, suffix, kept):
    document = nerfstudio_scene(tmp_path)
    path = tmp_path / f"images/x{suffix}"
    write_image(path, size=(60, 48))
    document["frames"][2] |= {
        "file_path": f"images/x{suffix}",
        "fl_x": 50.0,
        "w": 60,
        "h": 48,
        "cx": 30,
        "cy": 24,
    }
    document["frames"][2]["fl_y"] = 50.0
    dataset = read_dataset(save(tmp_path, document))
    load_images(dataset)  # good before the cut
    path.write_bytes(path.read_bytes()[: int(path.stat().st_size * kept)])
    with pytest.raises(InputError) as caught:
        load_images(read_dataset(save(tmp_path, document), strict=True))
    assert caught.value.code in ("image_truncated", "not_an_image")
    assert_complete(caught.value, caught.value.code, f"images/x{suffix}")


def test_an_image_that_changes_under_the_reader_is_refused(tmp_path):
    dataset = read_dataset(save(tmp_path, nerfstudio_scene(tmp_path)))
    write_image(tmp_path / "images/001.jpg", size=(8, 8))
    with pytest.raises(InputError) as caught:
        load_images(dataset)
    assert_complete(caught.value, "image_changed", "images/001.jpg")


def test_flipped_bytes_give_pixels_or_a_complete_error(tmp_path):
    rng = np.random.default_rng(0)
    for suffix in (".png", ".jpg", ".webp", ".tif"):
        document = nerfstudio_scene(tmp_path)
        path = tmp_path / f"images/x{suffix}"
        write_image(path)
        document["frames"][0]["file_path"] = f"images/x{suffix}"
        json_path = save(tmp_path, document)
        good = path.read_bytes()
        for _ in range(60):
            content = bytearray(good)
            for position in rng.integers(0, len(content), 4):
                content[position] = rng.integers(0, 256)
            path.write_bytes(content)
            try:
                load_images(read_dataset(json_path))
            except InputError as error:
                assert_complete(error, error.code)


def _framed(colour: int, rng: np.random.Generator) -> np.ndarray:
    image = np.clip(rng.normal(colour, 1.5, (40, 50, 3)), 0, 255).astype(np.uint8)
    image[10:40, 15:35] = rng.integers(0, 256, (30, 20, 3))  # the object reaches the lower border
    return image


def _background(images: list[np.ndarray], counts: list[np.ndarray | None] | None = None):
    found = uniform_background(images, counts or [None] * len(images))
    return None if found is None else found.tolist()


def test_plain_borders_show_the_background_and_others_do_not():
    rng = np.random.default_rng(0)
    assert _background([_framed(6, rng) for _ in range(10)]) == [0, 0, 0]
    assert _background([_framed(255, rng) for _ in range(10)]) == [1, 1, 1]
    assert _background([_framed(128, rng) for _ in range(10)]) is None
    assert _background([_framed(6, rng) for _ in range(5)] + [_framed(90, rng) for _ in range(5)]) is None


def test_a_few_photos_of_another_scene_leave_the_background_known():
    rng = np.random.default_rng(0)
    foreign = [_framed(128, rng) for _ in range(3)]
    assert _background([_framed(255, rng) for _ in range(25)] + foreign) == [1, 1, 1]
    assert _background([_framed(255, rng) for _ in range(7)] + foreign) is None


def test_masked_borders_have_no_say_about_the_background():
    rng = np.random.default_rng(0)
    images = [_framed(6, rng) for _ in range(10)]
    for image in images:
        image[:, :20] = 128  # someone stands there
    assert _background(images) is None
    counts = np.ones((40, 50), dtype=bool)
    counts[:, :20] = False
    assert _background(images, [counts] * 10) == [0, 0, 0]
    assert _background(images, [np.zeros((40, 50), dtype=bool)] * 10) is None


def test_no_more_large_pictures_are_decoded_at_once_than_fit_into_memory(tmp_path, monkeypatch):
    dataset = png_scene(tmp_path, [noise(index, HEIGHT, WIDTH, 4) for index in range(8)])
    lock, now, most = threading.Lock(), [0], [0]

    def counted(frame, camera):
        with lock:
            now[0] += 1
            most[0] = max(most[0], now[0])
        time.sleep(0.02)
        try:
            return decode(frame, camera)
        finally:
            with lock:
                now[0] -= 1

    monkeypatch.setattr("biresnerf.data.photos.images.decode", counted)
    monkeypatch.setattr("os.sched_getaffinity", lambda _pid: set(range(16)), raising=False)
    load_images(dataset)
    assert most[0] > 3
    most[0] = 0
    monkeypatch.setattr("biresnerf.data.photos.images._DECODING_BYTES", 3 * 16 * HEIGHT * WIDTH)
    load_images(dataset)
    assert most[0] == 3


def test_each_photo_that_is_decoded_is_counted_and_the_caller_may_end_it(tmp_path):
    dataset = read_dataset(save(tmp_path, nerfstudio_scene(tmp_path, 6)))
    counts: list[int] = []
    load_images(dataset, on_photo=counts.append)
    assert counts == [1, 2, 3, 4, 5, 6]

    def stop(done: int) -> None:
        if done == 2:
            raise Interrupted("enough")

    with pytest.raises(Interrupted, match="enough"):
        load_images(dataset, on_photo=stop)


def shown_before(background: int, side: int, top: int, left: int, height: int, width: int) -> np.ndarray:
    picture = np.full((side, side, 3), background, dtype=np.uint8)
    picture[top : top + height, left : left + width] = 128
    return picture


@pytest.mark.parametrize("background", [0, 255])
def test_what_is_shown_before_an_even_background_is_found_but_for_specks(tmp_path, background):
    pictures = [shown_before(background, 200, 60 + i, 30, 50, 80) for i in range(4)]
    for picture in pictures:
        picture[2, 197] = 128
    images = load_images(square_scene(tmp_path, pictures))
    for i in range(4):
        np.testing.assert_allclose(images.content_box(i), [[30, 60 + i], [110, 110 + i]], atol=1.0)
    surroundings = load_images(square_scene(tmp_path, pictures), background="none")
    assert surroundings.content_box(0) is None


@pytest.mark.parametrize(
    ("side", "length", "shown"),
    [
        (200, 190, 64),
        (200, 100, 64),  # half of it already
        (200, 50, 128),
        (200, 25, 200),  # the file has no more
        (600, 30, 256),  # four times as large at most
        (60, 10, 60),
    ],
)
def test_photos_of_a_small_thing_are_as_large_as_shows_it_at_half_the_working_size(
    tmp_path, side, length, shown
):
    pictures = [shown_before(0, side, side // 3, side // 3, length, length // 2) for _ in range(4)]
    if length > side // 2:
        pictures = [shown_before(0, side, 5, 5, length, length) for _ in range(4)]
    dataset = square_scene(tmp_path, pictures)
    images = load_by_content(dataset, 64, "auto")
    assert images.widths.tolist() == [pytest.approx(shown, rel=0.03)] * 4
    assert load_by_content(dataset, 64, "none").widths.tolist() == [min(side, 64)] * 4
