"""Area averaging against a slow exact average, and against the geometry of the picture."""

from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from biresnerf.data.photos.area_resize import area_resize


def by_loops(picture: np.ndarray, width: int, height: int) -> np.ndarray:
    """Every output pixel by the areas of the source pixels that it covers."""
    source_height, source_width = picture.shape[:2]
    out = np.zeros((height, width, picture.shape[2]))
    for row in range(height):
        for column in range(width):
            top, bottom = row * source_height / height, (row + 1) * source_height / height
            left, right = column * source_width / width, (column + 1) * source_width / width
            total = 0.0
            for y in range(int(top), min(math.ceil(bottom), source_height)):
                for x in range(int(left), min(math.ceil(right), source_width)):
                    area = (min(bottom, y + 1) - max(top, y)) * (min(right, x + 1) - max(left, x))
                    out[row, column] += area * picture[y, x]
                    total += area
            out[row, column] /= total
    return out


@settings(max_examples=60, deadline=None)
@given(
    st.integers(1, 13), st.integers(1, 13), st.integers(1, 13), st.integers(1, 13), st.integers(0, 2**32 - 1)
)
def test_every_pixel_is_the_mean_of_what_it_covers(source_width, source_height, width, height, seed):
    width, height = min(width, source_width), min(height, source_height)
    picture = np.random.default_rng(seed).integers(0, 256, (source_height, source_width, 3), dtype=np.uint8)
    np.testing.assert_allclose(
        area_resize(picture, width, height), by_loops(picture, width, height), atol=1e-3
    )


@given(st.integers(20, 200), st.integers(5, 20))
def test_a_ramp_stays_a_ramp_so_nothing_is_shifted(source, size):
    ramp = (np.arange(source) + 0.5)[None, :, None].astype(np.float32)
    small = area_resize(ramp, size, 1)[0, :, 0]
    # Pixels are flat squares, so a part of one counts from its middle: at most an eighth off at either end.
    shift = np.abs(small - (np.arange(size) + 0.5) * source / size)
    assert shift.max() <= 0.25 * size / source + 1e-4


def test_halves_are_the_same_in_one_piece_as_row_by_row(monkeypatch):
    picture = np.random.default_rng(0).integers(0, 256, (12, 16, 3), dtype=np.uint8)
    in_one_piece = area_resize(picture, 8, 6)
    assert np.array_equal(in_one_piece, picture.reshape(6, 2, 8, 2, 3).mean((1, 3)))
    monkeypatch.setattr("biresnerf.data.photos.area_resize._AT_ONCE", 0)
    assert np.array_equal(area_resize(picture, 8, 6), in_one_piece)


def test_values_of_rows_are_averaged_in_place_of_the_picture():
    picture = np.random.default_rng(1).integers(0, 256, (9, 8, 4), dtype=np.uint8)
    doubled = area_resize(picture, 4, 3, lambda rows: 2 * rows.astype(np.float32))
    np.testing.assert_allclose(doubled, 2 * area_resize(picture, 4, 3), rtol=1e-6)


def test_enlarging_is_refused():
    with pytest.raises(ValueError, match="cannot average"):
        area_resize(np.zeros((4, 4, 3), np.uint8), 5, 4)
