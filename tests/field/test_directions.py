"""Viewing directions from the backends' kernels against the geometry's own."""

from __future__ import annotations

import importlib

import pytest
import torch

from biresnerf.field.backends import directions_for
from biresnerf.geometry.camera import camera
from biresnerf.geometry.camera.camera_models import Camera

PINHOLE = Camera("PINHOLE", 320, 240, (300.0, 310.0, 160.0, 118.0))
OPENCV = Camera("OPENCV", 320, 240, (300.0, 310.0, 160.0, 118.0, -0.12, 0.03, 0.002, -0.003))
FULL = (252.0, 252.0, 160.0, 120.0, 0.52, -2.69, 0.0006, -0.0002, 1.5, 0.4, -2.5, 1.43)
FISHEYE = Camera("OPENCV_FISHEYE", 320, 240, (110.0, 108.0, 160.0, 118.0, 0.02, -0.004, 0.001, -0.0002))

CARRIED = Camera("EUCM", 320, 240, (110.0, 108.0, 160.0, 118.0, 0.6, 1.1))


@pytest.fixture(params=["cpu", "cuda"])
def kernel(request: pytest.FixtureRequest):
    """The backend's `directions_in_cam`, and where its tensors live."""
    if request.param == "cpu":
        return directions_for(torch.device("cpu")), torch.device("cpu")
    pytest.importorskip(
        "triton",
        minversion="3.2",
        reason="the CUDA backend's kernels need Triton, for Linux only; its interpreter runs them from 3.2 on",
    )
    module = importlib.import_module("biresnerf.field.cuda.cameras.lens")
    return module.directions_in_cam, torch.device("cuda" if torch.cuda.is_available() else "cpu")


@pytest.mark.parametrize(
    "cameras",
    [
        (PINHOLE, PINHOLE),
        (OPENCV, PINHOLE),
        (OPENCV, Camera("FULL_OPENCV", 320, 240, FULL)),
        (FISHEYE, OPENCV),
        (CARRIED, OPENCV),
    ],
)
def test_directions_equal_those_of_the_geometry(kernel, cameras):
    directions, device = kernel
    assert directions is not camera.directions_in_cam
    intrinsics = camera.Intrinsics.from_cameras(cameras).to(device)
    generator = torch.Generator().manual_seed(1)
    xy = torch.rand(300, 2, generator=generator) * torch.tensor([320, 240])
    xy[0] = torch.tensor([160.0, 118.0])  # straight ahead, where a fisheye's angle is zero
    image = torch.randint(0, 2, (300,), generator=generator)
    image[0] = 0
    image, xy = image.to(device), xy.to(device)
    expected = camera.directions_in_cam(intrinsics, image, xy)
    torch.testing.assert_close(directions(intrinsics, image, xy), expected, rtol=0, atol=2e-7)
    assert directions(intrinsics, image[:0], xy[:0]).shape == (0, 3)
