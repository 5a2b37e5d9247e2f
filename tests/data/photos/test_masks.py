"""Masks in any form: which pixels count; at working size, only those that count completely."""

from __future__ import annotations

import json
import subprocess
import sys
from dataclasses import replace
from functools import partial
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from biresnerf.data.formats.read_dataset import read_dataset
from biresnerf.data.model.dataset import Dataset, Frame, SourceFormat
from biresnerf.data.photos.images import load_images
from biresnerf.data.photos.masks import load_mask, mask_beside, refuse_unfit_mask, shrink_mask, write_masks
from biresnerf.errors import InputError
from biresnerf.geometry.camera.camera_models import Camera
from tests.data.scenes import HEIGHT, WIDTH, assert_complete, nerfstudio_scene, save, textured_arc

CAMERA = Camera("SIMPLE_PINHOLE", WIDTH, HEIGHT, (20.0, WIDTH / 2, HEIGHT / 2))
PATTERN = np.random.default_rng(0).random((HEIGHT, WIDTH)) < 0.6  # no symmetry, so no turn goes unseen
BLOCKS = np.kron(PATTERN[:4, :4], np.ones((4, 5), dtype=bool))  # 8 px would fit JPEG's own blocks


def _frame(mask: Path, orientation: int = 1) -> Frame:
    return Frame(
        "images/a.jpg", mask.with_name("a.jpg"), 0, np.eye(4), "given", mask=mask, orientation=orientation
    )


def _stored(counts: np.ndarray, form: str) -> Image.Image:
    grey = Image.fromarray(counts.astype(np.uint8) * 255)
    if form in ("L", "1", "RGB", "CMYK"):
        return grey.convert(form)
    if form == "LA":
        return Image.merge("LA", (grey, Image.new("L", grey.size, 255)))
    if form == "alpha alone":  # white everywhere; what does not count is transparent
        return Image.merge("RGBA", (*Image.new("RGB", grey.size, (255, 255, 255)).split(), grey))
    if form == "zeros and ones":
        return Image.fromarray(counts.astype(np.uint8))
    if form == "16 bit":
        return Image.fromarray(counts.astype(np.uint16))
    if form == "float":
        return Image.fromarray(counts.astype(np.float32))
    assert form == "palette"
    indices = Image.frombytes("P", grey.size, (~counts).astype(np.uint8).tobytes())
    indices.putpalette([200, 30, 0, 0, 0, 0])
    return indices


@pytest.mark.parametrize(
    "form", ["L", "1", "RGB", "LA", "alpha alone", "zeros and ones", "16 bit", "palette", "CMYK", "float"]
)
def test_black_does_not_count_and_all_else_does_in_every_form(tmp_path, form):
    path = tmp_path / ("mask.tif" if form in ("CMYK", "float") else "mask.png")
    _stored(PATTERN, form).save(path)
    assert np.array_equal(load_mask(_frame(path), CAMERA), PATTERN)
    assert np.array_equal(load_mask(replace(_frame(path), mask_inverted=True), CAMERA), ~PATTERN)


def test_a_mask_that_lies_ready_is_not_taken_from_outside_of_what_was_sent(tmp_path):
    sent, other = tmp_path / "sent", tmp_path / "other.png"
    _stored(PATTERN, "L").save(other)
    for name in ("masks/a.jpg.png", "images/dynamic_mask_a.png"):
        link = sent / name
        link.parent.mkdir(parents=True)
        link.symlink_to(other)
        found = partial(mask_beside, sent, sent / "images/a.jpg", "images/a.jpg")
        assert found(within=sent) == (None, False)
        assert found(within=tmp_path)[0] == found()[0] == link
        link.unlink()
        link.write_bytes(other.read_bytes())
        assert found(within=sent)[0] == link
        link.unlink()


@pytest.mark.parametrize("suffix", [".jpg", ".webp"])
def test_formats_with_losses_are_split_in_the_middle(tmp_path, suffix):
    path = tmp_path / f"mask{suffix}"
    _stored(BLOCKS, "L").convert("RGB").save(path, quality=60)
    stored = np.asarray(Image.open(path).convert("L"))
    assert ((stored > 0) & (stored < 64)).any(), "no pixel is nearly black: this test shows nothing"
    assert np.array_equal(load_mask(_frame(path), CAMERA), BLOCKS)


def test_a_pixel_of_working_size_counts_where_all_that_it_covers_does():
    counts = np.ones((12, 30), dtype=bool)
    counts[5, 7] = counts[0, 29] = False
    expected = np.ones((4, 9), dtype=bool)  # boxes of 3 x 3.33 px
    expected[1, 2] = expected[0, 8] = False
    assert np.array_equal(shrink_mask(counts, 9, 4), expected)
    counts[5, 6] = False  # a third of it lies in the next column of boxes
    expected[1, 1] = False
    assert np.array_equal(shrink_mask(counts, 9, 4), expected)


@pytest.mark.parametrize("size", [(7, 5), (WIDTH, HEIGHT), (33, 21)])
def test_shrinking_and_growing_agree_with_looking_at_every_pixel_covered(size):
    width, height = size
    result = shrink_mask(BLOCKS, width, height)
    for y in range(height):
        for x in range(width):
            rows = slice(
                int(np.floor(y * HEIGHT / height + 1e-9)), int(np.ceil((y + 1) * HEIGHT / height - 1e-9))
            )
            columns = slice(
                int(np.floor(x * WIDTH / width + 1e-9)), int(np.ceil((x + 1) * WIDTH / width - 1e-9))
            )
            assert result[y, x] == BLOCKS[rows, columns].all()


def test_a_mask_of_dots_leaves_the_pixels_with_most_of_them():
    counts = np.zeros((16, 16), dtype=bool)
    counts[::4, ::4] = True
    counts[1, 5] = True
    small = shrink_mask(counts, 4, 4)
    assert np.argwhere(small).tolist() == [[0, 1]]


@pytest.mark.parametrize("factor", [2, 0.5])
def test_a_mask_at_another_scale_is_scaled_to_the_photo(tmp_path, factor):
    counts = np.ones((int(HEIGHT * factor), int(WIDTH * factor)), dtype=bool)
    counts[: int(6 * factor), : int(4 * factor)] = False
    Image.fromarray(counts.astype(np.uint8) * 255).save(tmp_path / "mask.png")
    loaded = load_mask(_frame(tmp_path / "mask.png"), CAMERA)
    expected = np.ones((HEIGHT, WIDTH), dtype=bool)
    expected[:6, :4] = False
    assert loaded is not None
    assert np.array_equal(shrink_mask(loaded, WIDTH, HEIGHT), expected)


@pytest.mark.parametrize("suffix", [".png", ".tif"])
@pytest.mark.parametrize("tagged", [False, True])
@pytest.mark.parametrize("orientation", [6, 8])
def test_a_mask_of_a_turned_photo_is_turned_with_it_unless_it_is_turned_already(
    tmp_path, suffix, tagged, orientation
):
    portrait = Camera("SIMPLE_PINHOLE", HEIGHT, WIDTH, (20.0, HEIGHT / 2, WIDTH / 2))
    shown = np.rot90(PATTERN, -1 if orientation == 6 else 1)
    exif = Image.Exif()
    if tagged:
        exif[0x0112] = orientation
    _stored(PATTERN, "L").save(tmp_path / f"stored{suffix}", exif=exif)
    _stored(shown, "L").save(tmp_path / f"shown{suffix}")
    for name in ("stored", "shown"):
        assert np.array_equal(load_mask(_frame(tmp_path / f"{name}{suffix}", orientation), portrait), shown)


def _masked_set(folder: Path, masks: dict[int, np.ndarray]) -> Dataset:
    """A scene of four photos, some with a mask."""
    dataset = read_dataset(save(folder, nerfstudio_scene(folder)))
    frames = list(dataset.frames)
    for index, counts in masks.items():
        path = folder / f"mask{index}.png"
        _stored(counts, "L").save(path)
        frames[index] = replace(frames[index], mask=path)
    return replace(dataset, frames=tuple(frames))


def test_images_without_a_mask_count_wholly_beside_those_with_one(tmp_path):
    images = load_images(_masked_set(tmp_path, {1: PATTERN}))
    assert np.array_equal(images.counts_image(1), PATTERN)
    assert all(images.counts_image(i).all() for i in (0, 2, 3))
    assert load_images(_masked_set(tmp_path, {})).counts is None


def test_a_mask_does_not_change_the_photo(tmp_path):
    plain, masked = (
        load_images(_masked_set(tmp_path, {}), 9),
        load_images(_masked_set(tmp_path, {0: BLOCKS}), 9),
    )
    assert np.array_equal(plain.pixels, masked.pixels)


def test_a_mask_of_another_shape_is_refused_with_both_sizes(tmp_path):
    dataset = _masked_set(tmp_path, {2: np.ones((HEIGHT, WIDTH + 4), dtype=bool)})
    for check in (
        lambda: load_images(dataset),
        lambda: refuse_unfit_mask(dataset.frames[2], dataset.camera_of(2)),
    ):
        with pytest.raises(InputError) as caught:
            check()
        assert_complete(caught.value, "mask_size_mismatch", "images/002.jpg", "mask2.png")
        assert "24 x 16" in caught.value.detail
        assert "20 x 16" in caught.value.detail


def test_a_mask_that_hides_the_whole_photo_is_refused(tmp_path):
    with pytest.raises(InputError) as caught:
        load_images(_masked_set(tmp_path, {2: np.zeros((HEIGHT, WIDTH), dtype=bool)}))
    assert_complete(caught.value, "mask_hides_image", "images/002.jpg", "mask2.png")


def test_a_mask_that_is_no_image_is_refused_by_name(tmp_path):
    dataset = _masked_set(tmp_path, {0: PATTERN})
    content = (tmp_path / "mask0.png").read_bytes()
    for spoilt in (b"", b"no image", content[: len(content) // 2]):
        (tmp_path / "mask0.png").write_bytes(spoilt)
        with pytest.raises(InputError) as caught:
            load_images(dataset)
        assert_complete(caught.value, caught.value.code, "mask0.png")
        assert caught.value.code in ("not_an_image", "image_truncated")


def test_colmap_is_given_full_size_masks_under_its_own_names(tmp_path):
    small = np.ones((HEIGHT // 2, WIDTH // 2), dtype=bool)
    small[0, 0] = False
    dataset = _masked_set(tmp_path, {1: PATTERN, 3: small})
    names = ["a.jpg", "b/c.jpg", "d.jpg", "e.jpg"]
    assert write_masks(dataset, names, tmp_path / "masks")
    assert (np.asarray(Image.open(tmp_path / "masks/a.jpg.png")) == 255).all()
    assert np.array_equal(np.asarray(Image.open(tmp_path / "masks/b/c.jpg.png")), PATTERN * np.uint8(255))
    corner = np.asarray(Image.open(tmp_path / "masks/e.jpg.png"))
    assert (corner[:2, :2] == 0).all()
    assert (corner > 0).sum() == HEIGHT * WIDTH - 4
    assert not write_masks(_masked_set(tmp_path, {}), names, tmp_path / "none")


@pytest.mark.parametrize(
    "mask",
    [
        "masks/{name}.png",
        "masks/{stem}.png",
        "masks/{stem}_mask.JPG",
        "images/{name}.mask.png",
        "images/{stem}_mask.png",
    ],
)
def test_masks_are_found_under_the_names_that_other_programs_give_them(tmp_path, mask):
    for number in range(3):
        path = tmp_path / mask.format(name=f"{number}.jpg", stem=number)
        path.parent.mkdir(exist_ok=True)
        _stored(BLOCKS, "L").save(path)
        (tmp_path / "images").mkdir(exist_ok=True)
        Image.new("RGB", (WIDTH, HEIGHT), (90, 9, 200)).save(tmp_path / f"images/{number}.jpg")
    dataset = read_dataset(tmp_path)
    assert len(dataset) == 3
    for index, frame in enumerate(dataset.frames):
        assert np.array_equal(load_mask(frame, dataset.camera_of(index)), BLOCKS)
    assert dataset.warnings == ("masks were found for 3 of 3 images",)


def test_pictures_among_the_masks_that_fit_no_photo_are_said(tmp_path):
    document = nerfstudio_scene(tmp_path)
    for folder in ("masks", "object_mask"):
        (tmp_path / folder).mkdir()
        _stored(PATTERN, "L").save(tmp_path / folder / "x_1.png")
    warnings = read_dataset(save(tmp_path, document)).warnings
    for folder in ("masks", "object_mask"):
        assert any(
            f"{folder}/ holds 1 pictures that are not used as masks (x_1.png)" in text for text in warnings
        )


FEATURES = """
import zlib, json, sys  # zlib first: pycolmap's own breaks Python's
import pycolmap

reader = pycolmap.ImageReaderOptions()
reader.mask_path = "masks"
extraction = pycolmap.FeatureExtractionOptions()
extraction.num_threads = 1
pycolmap.extract_features(
    "made.db", "photos", image_names=json.loads(sys.argv[1]), reader_options=reader, extraction_options=extraction
)
database = pycolmap.Database.open("made.db")
found = {i.name: [float(x) for x in database.read_keypoints(i.image_id)[:, 0]] for i in database.read_all_images()}
print("FOUND " + json.dumps(found))
"""


def test_colmap_finds_nothing_under_a_mask_and_leaves_no_photo_out(tmp_path):
    size = 120
    textured_arc(tmp_path / "photos", 2, size)
    names = ["00.png", "01.png"]
    camera = Camera("SIMPLE_PINHOLE", size, size, (100.0, size / 2, size / 2))
    counts = np.ones((size, size), dtype=bool)
    counts[:, : size // 2] = False
    _stored(counts, "L").save(tmp_path / "half.png")
    frames = tuple(Frame(name, tmp_path / "photos" / name, 0, np.eye(4), "given") for name in names)
    frames = (replace(frames[0], mask=tmp_path / "half.png"), frames[1])
    dataset = Dataset(tmp_path / "photos", (camera,), frames, SourceFormat("images", None, {}, np.eye(4)))
    assert write_masks(dataset, names, tmp_path / "masks")
    outcome = subprocess.run(
        [sys.executable, "-c", FEATURES, json.dumps(names)],
        cwd=tmp_path,
        capture_output=True,
        text=True,
        check=True,
    )
    found = json.loads(
        next(line for line in outcome.stdout.splitlines() if line.startswith("FOUND ")).removeprefix("FOUND ")
    )
    assert min(found["00.png"]) >= size // 2
    assert len(found["00.png"]) > 5
    assert min(found["01.png"]) < size // 2
