"""From a correction of ideal pixels back to a camera of the user's own model."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from biresnerf.geometry.camera.camera_models import MODEL_PARAMETERS, Camera, FullParameters

RADII = 64


def corrected_camera(camera: Camera, correction: NDArray[np.float64]) -> Camera:
    """A camera after a correction [3] (log focal length, k1, k2; see `Cameras`), in the same model.

    The corrected lens shows slopes u where the camera shows e^l (1 + k1 |u|^2 + k2 |u|^4) u. For the focal length that
    is a lens of the same model, exactly; so it is for a camera without distortion. Otherwise the coefficients k1 and k2
    that the model has are fitted, over all radii within the image. Fisheyes have no correction.
    """
    if not correction.any():
        return camera
    longer = float(np.exp(correction[0]))
    old = camera.full()
    lens = old._replace(
        fx=old.fx * longer, fy=old.fy * longer, p1=old.p1 * longer, p2=old.p2 * longer,
        k1=old.k1 * longer**2, k2=old.k2 * longer**4, k3=old.k3 * longer**6,
        k4=old.k4 * longer**2, k5=old.k5 * longer**4, k6=old.k6 * longer**6,
    )  # fmt: skip
    names = radial_names(camera)
    if names and correction[1:].any():
        radius = np.linspace(0, corner(camera), RADII + 1)[1:]
        aim = _shown(lens, radius * (1 + correction[1] * radius**2 + correction[2] * radius**4))
        without = lens._replace(k1=0.0, k2=0.0 if "k2" in names else lens.k2)
        below = 1 + lens.k4 * radius**2 + lens.k5 * radius**4 + lens.k6 * radius**6
        columns = np.stack([radius ** (3 + 2 * i) / below for i in range(len(names))], 1)
        found = np.linalg.lstsq(columns, aim - _shown(without, radius), rcond=None)[0]
        lens = lens._replace(k1=float(found[0]), k2=float(found[1]) if "k2" in names else lens.k2)
    values = lens._asdict() | {"f": lens.fx}
    return replace(camera, params=tuple(values[name] for name in MODEL_PARAMETERS[camera.model]))


def radial_names(camera: Camera) -> list[str]:
    """Which of k1 and k2 a perspective camera's model has."""
    return [name for name in ("k1", "k2") if name in MODEL_PARAMETERS[camera.model]]


def corner(camera: Camera) -> float:
    """Distance of the farthest corner from the principal point, in focal lengths."""
    lens = camera.full()
    x, y = max(lens.cx, camera.width - lens.cx) / lens.fx, max(lens.cy, camera.height - lens.cy) / lens.fy
    return float(np.hypot(x, y))


def _shown(lens: FullParameters, radius: NDArray[np.float64]) -> NDArray[np.float64]:
    """Radii after the radial distortion."""
    s = radius**2
    above = 1 + s * (lens.k1 + s * (lens.k2 + s * lens.k3))
    return np.asarray(radius * above / (1 + s * (lens.k4 + s * (lens.k5 + s * lens.k6))))
