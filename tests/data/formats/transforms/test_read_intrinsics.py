"""One camera from a frame and the file around it: whichever way a lens is given, it is the same lens."""

from __future__ import annotations

import math
from typing import Any

import pytest

from biresnerf.data.formats.parsed_poses import FrameCamera
from biresnerf.data.formats.transforms.read_intrinsics import Fields, camera_of_frame
from biresnerf.data.photos.image_files import ImageHeader
from biresnerf.errors import InputError

WIDTH, HEIGHT, FOCAL = 640, 480, 500.0
ANGLE_X = 2 * math.atan(WIDTH / (2 * FOCAL))


def read(frame: dict[str, Any], top: dict[str, Any], size: tuple[int, int] = (WIDTH, HEIGHT)) -> FrameCamera:
    return camera_of_frame(Fields(frame, top, "transforms.json", 0), ImageHeader(*size), "a.png")


@pytest.mark.parametrize(
    "given",
    [
        {"fl_x": FOCAL, "fl_y": FOCAL},
        {"fl_x": FOCAL},
        {"camera_angle_x": ANGLE_X},
        {"x_fov": math.degrees(ANGLE_X)},
        {"camera_angle_x": ANGLE_X, "camera_angle_y": 0.7},  # a rounded angle of square pixels
    ],
    ids=["both focal lengths", "one focal length", "radians", "degrees", "both angles"],
)
def test_every_way_to_give_a_focal_length_gives_the_same_camera(given):
    for frame, top in ((given, {}), ({}, given)):
        lens = read(frame, top).camera.full()
        assert (lens.fx, lens.fy) == pytest.approx((FOCAL, FOCAL))
        assert (lens.cx, lens.cy) == (WIDTH / 2, HEIGHT / 2)


def test_a_frames_own_lens_goes_before_the_files_in_whatever_form():
    own = read({"camera_angle_x": ANGLE_X}, {"fl_x": 900.0, "fl_y": 900.0})
    assert own.camera.full().fx == pytest.approx(FOCAL)
    assert (own.shared, read({}, {"fl_x": 900.0}).shared) == (False, True)


def test_a_resized_copy_gets_the_lens_scaled_by_the_true_ratios():
    top = {"fl_x": FOCAL, "fl_y": FOCAL, "cx": 300.0, "cy": 250.0, "k1": 0.1, "w": WIDTH, "h": HEIGHT}
    lens = read({}, top, (WIDTH // 2, HEIGHT // 4 * 2)).camera.full()
    assert (lens.fx, lens.fy, lens.cx, lens.cy, lens.k1) == pytest.approx((250.0, 250.0, 150.0, 125.0, 0.1))


def test_opencv_without_distortion_is_a_pinhole():
    zeros = dict.fromkeys(("k1", "k2", "p1", "p2"), 0.0)
    assert (
        read({}, {"camera_model": "OPENCV", "fl_x": FOCAL, "fl_y": 501.0, **zeros}).camera.model == "PINHOLE"
    )


@pytest.mark.parametrize(
    ("top", "code", "field"),
    [
        ({"fl_x": -1.0}, "intrinsics_invalid", "fl_x"),
        ({"fl_x": True}, "intrinsics_invalid", "fl_x"),
        ({"camera_angle_x": math.pi}, "intrinsics_invalid", "camera_angle_x"),
        ({"k1": 0.1}, "intrinsics_missing", "frames[0]"),
        ({"fl_x": FOCAL, "cx": 5000.0}, "intrinsics_invalid", "cx"),
        ({"fl_x": FOCAL, "k4": 0.1}, "camera_model_unsupported", "k4"),
        ({"fl_x": FOCAL, "is_fisheye": True, "p1": 0.1}, "camera_model_unsupported", "p1"),
        ({"fl_x": FOCAL, "camera_model": "CYLINDER"}, "camera_model_unsupported", "camera_model"),
        ({"fl_x": FOCAL, "camera_model": "FOV"}, "intrinsics_invalid", "omega"),
        ({"fl_x": FOCAL, "camera_model": "EUCM", "alpha": 0.6}, "intrinsics_invalid", "beta"),
        (
            {"fl_x": FOCAL, "camera_model": "FOV", "omega": 0.9, "k1": 0.1},
            "camera_model_unsupported",
            "camera_model",
        ),
        ({"fl_x": FOCAL, "w": HEIGHT, "h": WIDTH}, "image_size_mismatch", "w"),
        ({"fl_x": FOCAL, "w": WIDTH, "h": WIDTH}, "image_size_mismatch", "w"),
    ],
)
def test_what_is_no_lens_is_refused_with_its_field(top, code, field):
    with pytest.raises(InputError) as refused:
        read({}, top)
    assert refused.value.code == code
    assert refused.value.where.endswith(field)


def test_a_frame_without_a_lens_gets_a_guess_that_says_so():
    guessed = read({}, {})
    assert guessed.source in {"exif", "guessed"}
    assert guessed.notes
