"""Photos as ideal cameras would have taken them, against OpenCV's published formula at every pixel."""

from __future__ import annotations

import numpy as np
import pytest

from biresnerf.geometry.camera.camera import Intrinsics
from biresnerf.geometry.camera.camera_models import Camera
from biresnerf.refinement.adjustment.ideal import ideal_cameras, straight_photo

LENSES = {
    "barrel": (-0.25, 0.06, 0.002, -0.001),
    "pincushion": (0.15, 0.02, -0.001, 0.002),
}


def opencv(
    x: np.ndarray, y: np.ndarray, lens: tuple[float, float, float, float]
) -> tuple[np.ndarray, np.ndarray]:
    """Slopes after distortion, as OpenCV's documentation of calib3d has them."""
    k1, k2, p1, p2 = lens
    r2 = x * x + y * y
    radial = 1 + k1 * r2 + k2 * r2 * r2
    return (
        x * radial + 2 * p1 * x * y + p2 * (r2 + 2 * x * x),
        y * radial + p1 * (r2 + 2 * y * y) + 2 * p2 * x * y,
    )


@pytest.mark.parametrize("size", [(640, 480), (301, 203), (34, 17)], ids=["even", "odd", "tiny"])
@pytest.mark.parametrize("name", LENSES)
def test_each_pixel_of_a_straight_photo_comes_from_where_the_lens_showed_it(name, size):
    width, height = size
    f, cx, cy = 0.75 * width, 0.51 * width, 0.48 * height
    intrinsics = Intrinsics.from_cameras([Camera("OPENCV", width, height, (f, f, cx, cy, *LENSES[name]))])
    y, x = np.mgrid[0:height, 0:width].astype(np.float64)
    own_place = np.stack([x, y, np.ones_like(x)], 2).astype(np.float32)  # linear: bilinear samples are exact
    straight, seen = straight_photo(own_place, 0, intrinsics, ideal_cameras(intrinsics))
    slopes = opencv((x + 0.5 - cx) / f, (y + 0.5 - cy) / f, LENSES[name])
    at = np.stack([f * slopes[0] + cx - 0.5, f * slopes[1] + cy - 0.5], 2)
    inside = ((at >= 0) & (at <= [width - 1, height - 1])).all(2)
    border = (np.abs(at) < 0.01).any(2) | (np.abs(at - [width - 1, height - 1]) < 0.01).any(2)
    np.testing.assert_array_equal(seen[~border], inside[~border])
    assert inside.mean() > 0.3
    np.testing.assert_allclose(
        straight[seen & inside][:, :2], at[seen & inside], atol=1 / width
    )  # what a lens bends within `NODES`
    np.testing.assert_allclose(straight[seen][:, 2], 1.0, atol=1e-5)
