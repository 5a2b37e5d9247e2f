"""From a correction of ideal pixels back to a camera of the user's own model, or of one that can hold it."""

from __future__ import annotations

import numpy as np

from biresnerf.arrays import Array
from biresnerf.geometry.camera.camera_models import (
    REFINED_PARAMETERS,
    Camera,
    FullParameters,
)
from biresnerf.geometry.camera.distortion import coefficients_of, distort
from biresnerf.geometry.camera.pixel_rays import rays_of_pixels
from biresnerf.refinement.adjustment.lens.fisheyes import corrected_fisheye
from biresnerf.refinement.adjustment.lens.lenses import ASPECT, CENTRE, DISTORTION, FOCAL

STEPS = 24  # along each side of the image, of the grid that the new lens is fitted to
FITTED = ("k1", "k2", "p1", "p2")


def corrected_camera(camera: Camera, correction: Array) -> Camera:
    """A camera after a correction [8] (see `lenses`), in the same model where that has a place for all of it.

    The corrected lens shows a direction where the camera would show another one. For a focal length that is a lens of
    the same model, exactly; so it is for a camera without distortion. Otherwise the principal point and the
    coefficients up to k2, p1 and p2 that the model has are fitted, over the whole image. Of a fisheye the correction is
    of its own parameters.
    """
    if not correction.any():
        return camera
    longer = float(np.exp(correction[FOCAL]))
    old = camera.full()
    if old.fisheye:
        return camera.with_lens(corrected_fisheye(old, correction))
    lens = old._replace(
        fx=old.fx * longer, fy=old.fy * longer, p1=old.p1 * longer, p2=old.p2 * longer,
        k1=old.k1 * longer**2, k2=old.k2 * longer**4, k3=old.k3 * longer**6,
        k4=old.k4 * longer**2, k5=old.k5 * longer**4, k6=old.k6 * longer**6,
    )  # fmt: skip
    if correction[FOCAL + 1 :].any():
        lens = _fitted(lens, camera, correction)
    return camera.with_lens(lens)


def _fitted(lens: FullParameters, camera: Camera, correction: Array) -> FullParameters:
    """A lens whose free parameters are fitted to the corrected camera over the whole image.

    In f, f k1, f k2, f p1, f p2 and the principal point everything is linear, if y is counted in fx.
    """
    old, slopes = camera.full(), _grid(camera)
    moved = dict(zip(FITTED, correction[DISTORTION].tolist(), strict=True))
    names = [name for name in FITTED if name in REFINED_PARAMETERS[camera.model] or moved[name]]
    aspect = float(np.exp(correction[ASPECT]))
    bent = _bent(slopes, FullParameters(1.0, 1.0, 0.0, 0.0, **moved)) * [1.0, aspect]
    shown = _bent(bent * np.exp(correction[FOCAL]) + correction[CENTRE], old)
    aspect *= old.fy / old.fx
    aim = (shown * [old.fx, old.fy] + [old.cx, old.cy]) / [1.0, aspect]
    without = lens._asdict() | dict.fromkeys(names, 0.0)
    plain = _bent(slopes, FullParameters(**without))
    ones, none = np.ones(len(slopes)), np.zeros(len(slopes))
    columns = [
        plain,
        *(_bent(slopes, FullParameters(**without | {name: 1.0})) - plain for name in names),
        np.stack([ones, none], 1),
        np.stack([none, ones / aspect], 1),
    ]
    matrix = np.stack([column.reshape(-1) for column in columns], 1)
    focal, *scaled, cx, cy = np.linalg.lstsq(matrix, aim.reshape(-1), rcond=None)[0].tolist()
    fitted = {name: value / focal for name, value in zip(names, scaled, strict=True)}
    return FullParameters(**without | fitted | {"fx": focal, "fy": focal * aspect, "cx": cx, "cy": cy})


def corner(camera: Camera) -> float:
    """Distance of the farthest corner from the principal point, in focal lengths."""
    lens = camera.full()
    x, y = max(lens.cx, camera.width - lens.cx) / lens.fx, max(lens.cy, camera.height - lens.cy) / lens.fy
    return float(np.hypot(x, y))


def _grid(camera: Camera) -> Array:
    """Slopes [m, 2] of pixels all over the image."""
    at = (np.arange(STEPS) + 0.5) / STEPS
    x, y = np.meshgrid(at * camera.width, at * camera.height)
    rays = rays_of_pixels(camera.full(), np.stack([x.ravel(), y.ravel()], 1))
    return np.asarray(rays[:, :2] / rays[:, 2:])


def _bent(slopes: Array, lens: FullParameters) -> Array:
    """Slopes [m, 2] after a lens's distortion."""
    return np.stack(distort(slopes[:, 0], slopes[:, 1], coefficients_of(lens)), 1)
