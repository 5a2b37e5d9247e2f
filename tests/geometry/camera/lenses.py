"""One lens of every camera model, for tests."""

from __future__ import annotations

WIDTH, HEIGHT = 640, 480

CAMERAS = {
    "SIMPLE_PINHOLE": (500.0, 320.0, 240.0),
    "PINHOLE": (500.0, 510.0, 321.0, 238.5),
    "SIMPLE_RADIAL": (500.0, 320.0, 240.0, -0.12),
    "RADIAL": (480.0, 318.0, 243.0, 0.08, -0.03),
    "OPENCV": (500.0, 505.0, 322.0, 236.0, -0.15, 0.04, 0.002, -0.0015),
    "OPENCV_FISHEYE": (300.0, 302.0, 322.0, 236.0, -0.02, 0.004, -0.0015, 0.0002),
    # A depth camera's calibration, whose large terms nearly cancel.
    "FULL_OPENCV": (505.0, 505.0, 320.0, 240.0, 0.52, -2.69, 0.0006, -0.0002, 1.5, 0.4, -2.5, 1.43),
    "SIMPLE_RADIAL_FISHEYE": (280.0, 320.0, 240.0, 0.01),
    "RADIAL_FISHEYE": (290.0, 318.0, 243.0, -0.03, 0.003),
    # ETH3D's calibrations are of this kind.
    "THIN_PRISM_FISHEYE": (
        300.0,
        302.0,
        322.0,
        236.0,
        -0.02,
        0.004,
        0.0009,
        -0.0006,
        -0.0015,
        0.0002,
        0.0011,
        -0.0007,
    ),
    "SIMPLE_FISHEYE": (280.0, 320.0, 240.0),
    "FISHEYE": (280.0, 283.0, 322.0, 237.0),
    "FOV": (420.0, 424.0, 322.0, 237.0, 0.92),
    "SIMPLE_DIVISION": (390.0, 318.0, 243.0, -0.25),
    "DIVISION": (300.0, 302.0, 322.0, 236.0, -0.3),
    "EUCM": (260.0, 261.0, 318.0, 243.0, 0.62, 1.08),
}
# Models with coefficients that OPENCV and OPENCV_FISHEYE lack: those of them that nerfstudio lacks as well.
BEYOND_OPENCV = {"FULL_OPENCV": ("k4", "k5", "k6"), "THIN_PRISM_FISHEYE": ("p1", "p2", "sx1", "sy1")}
