"""Camera models: the smallest that holds a lens, and what is refused."""

from __future__ import annotations

import pytest

from biresnerf.geometry.camera.camera_models import (
    FAMILY_MODELS,
    MODEL_PARAMETERS,
    Camera,
    FullParameters,
    full_parameters,
    smallest_model,
)
from tests.geometry.camera.lenses import CAMERAS, HEIGHT, WIDTH


@pytest.mark.parametrize("model", CAMERAS)
def test_a_camera_with_its_own_lens_is_the_same(model):
    camera = Camera(model, WIDTH, HEIGHT, CAMERAS[model])
    assert camera.with_lens(camera.full()) == camera


def test_a_model_that_cannot_hold_the_camera_is_left_for_one_that_can():
    assert smallest_model(FullParameters(500, 501, 320, 240), "SIMPLE_PINHOLE")[0] == "PINHOLE"
    assert smallest_model(FullParameters(500, 501, 320, 240, k1=0.1), "SIMPLE_RADIAL")[0] == "OPENCV"
    assert smallest_model(FullParameters(500, 500, 320, 240, p1=0.1), "RADIAL")[0] == "OPENCV"
    assert smallest_model(FullParameters(500, 500, 320, 240, k3=0.1), "OPENCV")[0] == "FULL_OPENCV"
    assert smallest_model(FullParameters(500, 500, 320, 240), None)[0] == "PINHOLE"
    fisheye = FullParameters(500, 501, 320, 240, k1=0.1, fisheye=True)
    assert smallest_model(fisheye, "RADIAL_FISHEYE")[0] == "OPENCV_FISHEYE"
    assert smallest_model(fisheye, "OPENCV")[0] == "OPENCV_FISHEYE"
    assert smallest_model(fisheye, None)[0] == "OPENCV_FISHEYE"
    assert smallest_model(fisheye._replace(p1=0.1), None)[0] == "THIN_PRISM_FISHEYE"
    with pytest.raises(ValueError, match="fisheye"):
        smallest_model(fisheye._replace(k5=0.1), None)
    with pytest.raises(ValueError, match="sx1"):
        smallest_model(FullParameters(500, 500, 320, 240, sx1=0.1), None)
    assert smallest_model(FullParameters(500, 500, 320, 240, k2=0.1), "SIMPLE_RADIAL")[0] == "RADIAL"


def test_unknown_models_and_wrong_counts_are_refused():
    with pytest.raises(ValueError, match="OPENCV_FISHEYE"):
        full_parameters("EUCM", (1.0,) * 6)
    for model in FAMILY_MODELS:
        with pytest.raises(ValueError, match="parameters"):
            full_parameters(model, (1.0,) * (len(MODEL_PARAMETERS[model]) + 1))
