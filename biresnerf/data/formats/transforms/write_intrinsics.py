"""Intrinsics into a transforms.json: as nerfstudio and instant-ngp name them."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any

import numpy as np

from biresnerf.data.model.conventions import file_from_world_from_cam
from biresnerf.data.model.refined_set import RefinedSet
from biresnerf.geometry.camera.camera_models import COEFFICIENTS, MODEL_PARAMETERS, Camera, FullParameters
from biresnerf.geometry.camera.carried_lenses import SHAPES

FOCAL_KEYS = ("fl_x", "fl_y", "camera_angle_x", "camera_angle_y", "x_fov", "y_fov")
_COLMAPS = ("FULL_OPENCV", "THIN_PRISM_FISHEYE", *SHAPES)


def family(camera: Camera) -> str:
    """``camera_model`` of the file; one of `_COLMAPS`, which nerfstudio does not know, where no simpler one will do."""
    if camera.model in _COLMAPS or camera.panorama:
        return camera.model
    return "OPENCV_FISHEYE" if camera.full().fisheye else "OPENCV"


def lens_values(camera: Camera) -> dict[str, Any]:
    """Size and intrinsics by their keys."""
    values: dict[str, Any] = {"w": camera.width, "h": camera.height}
    if camera.panorama:
        return {"camera_model": camera.model, **values}
    if camera.model in SHAPES:
        named = dict(zip(MODEL_PARAMETERS[camera.model], camera.params, strict=True))
        fx = named.get("f", named.get("fx"))
        values |= {"fl_x": fx, "fl_y": named.get("fy", fx), "cx": named["cx"], "cy": named["cy"]}
        return {**values, **{name: named[name] for name in SHAPES[camera.model]}}
    p = camera.full()
    values |= {"fl_x": p.fx, "fl_y": p.fy, "cx": p.cx, "cy": p.cy}
    names = ngp_coefficients(p) if camera.model not in _COLMAPS else MODEL_PARAMETERS[camera.model][4:]
    return values | {name: getattr(p, name) for name in names}


def ngp_coefficients(lens: FullParameters) -> tuple[str, ...]:
    """The coefficients that instant-ngp knows. It would take p1 and p2 of a fisheye for its k3 and k4."""
    return ("k1", "k2", "k3", "k4") if lens.fisheye else ("k1", "k2", "p1", "p2")


def listed_frames(
    refined: RefinedSet, lenses: Sequence[dict[str, Any]], more: Sequence[dict[str, Any]] | None = None
) -> tuple[dict[str, Any], list[dict[str, Any]]]:
    """The entries of a file in the set's own world: a single lens for all frames, and each frame with its ``more``."""
    shared = lenses[0] if len(lenses) == 1 else {}
    matrices = file_from_world_from_cam(refined.world_from_cam, np.eye(4), 1.0)
    return shared, [
        {
            "file_path": image.file_name,
            **({} if shared else lenses[image.camera]),
            **(more[index] if more else {}),
            "transform_matrix": matrix.tolist(),
        }
        for index, (image, matrix) in enumerate(zip(refined.images, matrices, strict=True))
    ]


def has_own_intrinsics(place: dict[str, Any]) -> bool:
    """Whether a frame brings intrinsics of its own."""
    return any(place.get(key) is not None for key in (*FOCAL_KEYS, "cx", "cy", *COEFFICIENTS))


def put_lens(place: dict[str, Any], camera: Camera) -> None:
    """Change what a frame, or the file's top level, says of the lens to ``camera``, under the keys that are there.

    Angles stay angles where they suffice: a Blender file gets no focal length in pixels as long as its pixels are
    square and its principal point is in the middle. Other keys are added where they are not zero.
    """
    if camera.panorama:
        place |= lens_values(camera)
        return
    p, values = camera.full(), lens_values(camera)
    angles = {
        "camera_angle_x": 2 * math.atan(camera.width / (2 * values["fl_x"])),
        "camera_angle_y": 2 * math.atan(camera.height / (2 * values["fl_y"])),
    }
    angles |= {
        "x_fov": math.degrees(angles["camera_angle_x"]),
        "y_fov": math.degrees(angles["camera_angle_y"]),
    }
    plain = not p.distorted and p.fx == p.fy and (p.cx, p.cy) == (camera.width / 2, camera.height / 2)
    in_angles = plain and place.keys() & angles.keys() and not place.keys() & {"fl_x", "fl_y"}
    for key, angle in angles.items():
        if place.get(key) is not None:
            place[key] = angle
    if not in_angles:
        needed = {"w", "h", "fl_x", "fl_y", "cx", "cy"}
        place |= {k: v for k, v in values.items() if k in place or k in needed or v != 0.0}
    elif "w" in place or "h" in place:
        place |= {key: values[key] for key in ("w", "h") if key in place}
