"""One frame's camera from the intrinsics of a transforms.json: shared ones, the frame's own, or a mix."""

from __future__ import annotations

import math
from typing import Any

from biresnerf.data.formats.colmap.model_checks import camera_of_numbers
from biresnerf.data.formats.parsed_poses import FrameCamera, panorama_lens
from biresnerf.data.formats.transforms.write_intrinsics import FOCAL_KEYS
from biresnerf.data.photos.guessed_lens import guess_lens, guess_note
from biresnerf.data.photos.image_files import ImageHeader
from biresnerf.data.photos.orientation import same_shape
from biresnerf.errors import InputError
from biresnerf.geometry.camera.camera_models import (
    COEFFICIENTS,
    FISHEYE_MODELS,
    MODEL_IDS,
    MODEL_PARAMETERS,
    PANORAMA,
    Camera,
    FullParameters,
    of_shape,
    smallest_model,
)
from biresnerf.geometry.camera.carried_lenses import SHAPES
from biresnerf.geometry.camera.lens import lens_problem

_UNSUPPORTED = "camera_model_unsupported"
# Keys of instant-ngp that mean a lens of neither family.
_F_THETA, _LATLONG, _EQUAL_AREA = "ftheta_p0", "latlong", "equirectangular"
_FOCAL_DIFFERS = 0.01  # angles in files have few digits
_MODEL_HINT = (
    f"Supported are {', '.join(MODEL_IDS)}; undistort the images to one of them "
    "(for example with COLMAP's image_undistorter)."
)


class Fields:
    """Numbers looked up in the frame first and in the file's top level second."""

    def __init__(self, frame: dict[str, Any], top: dict[str, Any], file: str, index: int) -> None:
        self.frame, self.top, self.file, self.index = frame, top, file, index

    def where(self, key: str) -> str:
        """File and field of ``key``."""
        return f"{self.file} frames[{self.index}].{key}" if self.own(key) else f"{self.file} {key}"

    def own(self, key: str) -> bool:
        """Whether the frame itself has the key."""
        return self.frame.get(key) is not None

    def get(self, key: str) -> float | None:
        """The number, or None where neither has the key. Raises InputError for other than a finite number."""
        value = self.frame[key] if self.own(key) else self.top.get(key)
        if value is None:
            return None
        if isinstance(value, bool) or not isinstance(value, int | float) or not abs(value) < 1e12:
            raise self.invalid(
                key, f"{_short(value)} is not a usable number.", "Give a number (pixels for lengths)."
            )
        return float(value)

    def invalid(self, key: str, detail: str, hint: str) -> InputError:
        """The error for a value of ``key`` that no lens has."""
        return InputError("intrinsics_invalid", detail, where=self.where(key), hint=hint)


def camera_of_frame(fields: Fields, header: ImageHeader, name: str) -> FrameCamera:
    """The full-size camera of one frame.

    Raises:
        InputError: ``camera_model_unsupported``, ``intrinsics_missing``, ``intrinsics_invalid`` or
            ``image_size_mismatch``.
    """
    if _shows_all(fields):
        return panorama_lens(header, name)
    preferred, fisheye = _declared_lens(fields)
    width, height, notes = _declared_size(fields, header, name)
    if not any(fields.get(key) is not None for key in FOCAL_KEYS):
        return _guessed(fields, header, preferred, fisheye, notes)
    full, more = _parameters(fields, preferred, fisheye, width, height)
    if preferred in SHAPES:
        camera = _of_own_formula(fields, preferred, full, width, height)
    else:
        camera = _of_a_family(fields, preferred, full, width, height)
    shared = not any(fields.own(key) for key in ("fl_x", "fl_y", "camera_angle_x", "x_fov", "w", "h"))
    return FrameCamera(camera.resized(header.width, header.height), "given", shared, (*notes, *more))


def _of_own_formula(fields: Fields, model: str, full: FullParameters, width: int, height: int) -> Camera:
    """The lens of a model with parameters of its own: omega; alpha and beta; or k."""
    shape = [fields.get(key) for key in SHAPES[model]]
    for key, value in zip(SHAPES[model], shape, strict=True):
        if value is None:
            raise fields.invalid(key, f"{model} needs {', '.join(SHAPES[model])}.", f"Add {key}.")
    if full.distorted:
        raise _unsupported(fields, "camera_model", f"{model} has no coefficients such as k1 or p1.")
    model, params = of_shape(model, *full[:4], [value for value in shape if value is not None])
    return camera_of_numbers(model, width, height, params, fields.where("camera_model"))


def _of_a_family(
    fields: Fields, preferred: str | None, full: FullParameters, width: int, height: int
) -> Camera:
    # nerfstudio writes OPENCV with zeros for a pinhole; PINHOLE is the same camera and more programs read it.
    if preferred == "OPENCV" and not full.distorted:
        preferred = "PINHOLE"
    problem = lens_problem(full, width, height)
    if problem is not None:
        hint = "Check the coefficients k1, k2, ... and p1, p2, or undistort the images."
        raise fields.invalid("k1", problem, hint)
    model, params = smallest_model(full, preferred)
    return Camera(model, width, height, params)


def _guessed(
    fields: Fields, header: ImageHeader, model: str | None, fisheye: bool, notes: list[str]
) -> FrameCamera:
    """The lens of a frame without a focal length: EXIF's, or a normal lens, in the declared model.

    Raises:
        InputError: ``intrinsics_missing`` where the file describes the rest of the lens, or a fisheye.
    """
    given = [key for key in ("cx", "cy", *COEFFICIENTS) if fields.get(key)]
    if fisheye or given:
        what = f"{given[0]} is given" if given else "the lens is a fisheye"
        raise InputError(
            "intrinsics_missing",
            f"{what}, but no focal length: neither fl_x nor camera_angle_x.",
            where=f"{fields.file} frames[{fields.index}]",
            hint="Add fl_x (pixels) or camera_angle_x (radians), for all frames or in each; or leave out all of it.",
        )
    camera, source = guess_lens(header)
    if model is not None:
        name, params = smallest_model(camera.full(), model)
        camera = Camera(name, header.width, header.height, params)
    return FrameCamera(camera, source, False, (*notes, guess_note(source)))


def _short(value: Any) -> str:
    text = repr(value)
    return text if len(text) <= 40 else text[:37] + "..."


def _shows_all(fields: Fields) -> bool:
    """Whether the file calls the photo a panorama: by nerfstudio's camera model, or instant-ngp's key."""
    declared = fields.frame.get("camera_model") or fields.top.get("camera_model")
    latlong = fields.frame.get(_LATLONG) or fields.top.get(_LATLONG)
    return str(declared).upper() == PANORAMA or bool(latlong)


def _declared_lens(fields: Fields) -> tuple[str | None, bool]:
    """The model that the file names, and whether the lens is a fisheye's."""
    declared = fields.frame.get("camera_model") or fields.top.get("camera_model")
    if fields.frame.get(_EQUAL_AREA) or fields.top.get(_EQUAL_AREA):
        what = f"{_EQUAL_AREA}: instant-ngp's projection of this name is an equal-area one, which is not supported."
        raise _unsupported(fields, _EQUAL_AREA, what)
    if fields.frame.get(_F_THETA) or fields.top.get(_F_THETA):
        raise _unsupported(fields, _F_THETA, f"{_F_THETA}: f-theta lenses are not supported.")
    if declared is not None and (not isinstance(declared, str) or declared.upper() not in MODEL_IDS):
        raise _unsupported(fields, "camera_model", f"the camera model {_short(declared)} is not supported.")
    model = None if declared is None else declared.upper()
    flag = fields.frame.get("is_fisheye", fields.top.get("is_fisheye"))
    if flag not in (None, False, True):
        raise _unsupported(fields, "is_fisheye", f"{_short(flag)} is neither true nor false.")
    if flag and model is not None and model not in FISHEYE_MODELS:
        raise _unsupported(fields, "is_fisheye", f"is_fisheye is true, but camera_model is {model}.")
    return model, bool(flag) or model in FISHEYE_MODELS


def _unsupported(fields: Fields, key: str, what: str, also: str = "") -> InputError:
    return InputError(_UNSUPPORTED, what, where=fields.where(key), hint=_MODEL_HINT + also)


def _declared_size(fields: Fields, header: ImageHeader, name: str) -> tuple[int, int, list[str]]:
    """The size the intrinsics are meant for, and notes. The image's own size where the file names none."""
    width, height = fields.get("w"), fields.get("h")
    if width is None and height is None:
        return header.width, header.height, []
    # A file-wide size says nothing about frames that bring their own focal length and differ in size.
    if fields.own("fl_x") and not (fields.own("w") or fields.own("h")):
        return header.width, header.height, []
    w = header.width if width is None else round(width)
    h = header.height if height is None else round(height)
    if (w, h) == (header.width, header.height):
        return w, h, []
    if w <= 0 or h <= 0:
        raise fields.invalid("w", f"w = {w}, h = {h}.", "Give the size in pixels.")
    turned = (w, h) == (header.height, header.width)
    if turned or not same_shape(w, h, header.width, header.height):
        how = "turned by 90 degrees" if turned else "not the same shape"
        raise InputError(
            "image_size_mismatch",
            f"{name} has {header.width} x {header.height} px, the file says {w} x {h}: {how}.",
            where=fields.where("w"),
            hint="Rotate the stored pixels (or tag them with EXIF's orientation), or exchange w and h, cx and cy."
            if turned
            else "Give the intrinsics of these images; cropped images need their own cx and cy.",
        )
    scaled = f"{w} x {h} px in the file, {header.width} x {header.height} in the images"
    return w, h, [f"{scaled}: the intrinsics were scaled to the images"]


def _coefficients(fields: Fields, model: str | None, fisheye: bool) -> dict[str, float]:
    """Distortion by the names of `FullParameters`. Raises InputError for a term that the lens's model lacks."""
    values = {key: fields.get(key) or 0.0 for key in COEFFICIENTS}
    for key in () if fisheye else ("sx1", "sy1"):
        if values[key]:
            raise _unsupported(fields, key, f"{key} is not zero, but only THIN_PRISM_FISHEYE has it.")
    if model == "FULL_OPENCV":
        return values
    if fisheye:
        # instant-ngp keeps p1 and p2 in the places of k3 and k4, and the last one wins, which is never meant.
        thin_prism = model == "THIN_PRISM_FISHEYE"
        for key in ("k5", "k6") if thin_prism else ("p1", "p2", "k5", "k6", "sx1", "sy1"):
            if values[key]:
                has = MODEL_PARAMETERS["THIN_PRISM_FISHEYE" if thin_prism else "OPENCV_FISHEYE"][4:]
                raise _unsupported(
                    fields, key, f"{key} is not zero, but such a fisheye has {', '.join(has)} only."
                )
        return values
    for key in ("k4", "k5", "k6"):
        if values[key]:
            meaning = " In nerfstudio's files it is a fourth radial term, which no model of COLMAP's has."
            also = " If it is the rational model's, say camera_model FULL_OPENCV. If it is not needed, set it to 0."
            raise _unsupported(fields, key, f"{key} is not zero.{meaning if key == 'k4' else ''}", also)
    return values


def _parameters(
    fields: Fields, model: str | None, fisheye: bool, width: int, height: int
) -> tuple[FullParameters, list[str]]:
    coefficients = _coefficients(fields, model, fisheye)
    fx, key_x = _focal(fields, ("fl_x", "camera_angle_x", "x_fov"), width)
    fy, key_y = _focal(fields, ("fl_y", "camera_angle_y", "y_fov"), height)
    # camera_angle_y and y_fov come from rounded angles of square pixels: one focal length serves both axes.
    if fy is None or (fx is not None and key_x != "fl_x" and key_y != "fl_y"):
        fy = fx
    fx = fy if fx is None else fx
    assert fx is not None, "a frame without focal length has a guessed lens"
    assert fy is not None
    cx, cy = fields.get("cx"), fields.get("cy")
    notes = []
    pixels = fields.get("fl_x")
    if key_x == "x_fov" and pixels is not None and abs(pixels - fx) > _FOCAL_DIFFERS * fx:
        notes.append(
            f"x_fov and fl_x differ; x_fov was taken, as instant-ngp does ({fx:.6g} px, not {pixels:g})"
        )
    if key_x == "fl_x" and (cx is None or cy is None):
        notes.append("cx or cy is not given; the image centre was taken")
    cx, cy = width / 2 if cx is None else cx, height / 2 if cy is None else cy
    if not (-width < cx < 2 * width and -height < cy < 2 * height):
        detail = f"the principal point ({cx:g}, {cy:g}) lies far outside the image."
        raise fields.invalid("cx", detail, "Give cx and cy in pixels from the top left corner.")
    return FullParameters(fx, fy, cx, cy, **coefficients, fisheye=fisheye), notes


def _focal(fields: Fields, keys: tuple[str, str, str], size: int) -> tuple[float | None, str | None]:
    """Focal length (px) and the key it came from: pixels, an angle in radians, or instant-ngp's degrees."""
    # What the frame says goes before what the file says, whichever way it is put. Within one, instant-ngp's order
    # (read_focal_length in its nerf_loader.cu): degrees, pixels, radians; no other program knows the degrees.
    ordered = sorted((keys[2], keys[0], keys[1]), key=lambda key: not fields.own(key))
    for key in ordered:
        value = fields.get(key)
        if value is None:
            continue
        if key == keys[0]:
            focal, fits = value, value > 0.0
        else:
            angle = value if key == keys[1] else math.radians(value)
            fits = 0.0 < angle < math.pi
            if key == keys[2] and 0.0 < value < math.pi:
                hint = f"{keys[2]} is in degrees; give radians as {keys[1]}, or pixels as {keys[0]}."
                raise fields.invalid(key, f"{value:g} degrees are too narrow: it looks like radians.", hint)
            focal = 0.5 * size / math.tan(0.5 * angle) if fits else 0.0
        if not fits or not 1e-3 * size < focal < 1e5 * size:
            what = "a focal length" if key == keys[0] else "an angle of view"
            hint = "Give a positive focal length in pixels, or camera_angle_x in radians below pi."
            raise fields.invalid(key, f"{value:g} is not {what}.", hint)
        return focal, key
    return None, None
