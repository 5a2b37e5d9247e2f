"""COLMAP's camera models that this project supports, as plain numbers (needs no torch).

Two families. The perspective one is a special case of FULL_OPENCV: two focal lengths, a principal point, radial
coefficients of a rational function (k1 to k3 above, k4 to k6 below) and two tangential ones (p1, p2). The fisheye
one is a special case of THIN_PRISM_FISHEYE: k1 to k4 are the coefficients of a polynomial in the angle from the axis,
sx1 and sy1 those of a thin prism.
Lengths are in pixels; the centre of the first pixel lies at (0.5, 0.5).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

# All models of COLMAP 4.2 by their ids (src/colmap/sensor/models.h).
COLMAP_MODELS = (
    *("SIMPLE_PINHOLE", "PINHOLE", "SIMPLE_RADIAL", "RADIAL", "OPENCV", "OPENCV_FISHEYE", "FULL_OPENCV"),
    "FOV",
    *("SIMPLE_RADIAL_FISHEYE", "RADIAL_FISHEYE", "THIN_PRISM_FISHEYE", "RAD_TAN_THIN_PRISM_FISHEYE"),
    *("SIMPLE_DIVISION", "DIVISION", "SIMPLE_FISHEYE", "FISHEYE", "EUCM", "EQUIRECTANGULAR"),
)
# The models that are supported, with COLMAP's parameters in COLMAP's order.
MODEL_PARAMETERS: dict[str, tuple[str, ...]] = {
    "SIMPLE_PINHOLE": ("f", "cx", "cy"),
    "PINHOLE": ("fx", "fy", "cx", "cy"),
    "SIMPLE_RADIAL": ("f", "cx", "cy", "k1"),
    "RADIAL": ("f", "cx", "cy", "k1", "k2"),
    "OPENCV": ("fx", "fy", "cx", "cy", "k1", "k2", "p1", "p2"),
    "OPENCV_FISHEYE": ("fx", "fy", "cx", "cy", "k1", "k2", "k3", "k4"),
    "FULL_OPENCV": ("fx", "fy", "cx", "cy", "k1", "k2", "p1", "p2", "k3", "k4", "k5", "k6"),
    "SIMPLE_RADIAL_FISHEYE": ("f", "cx", "cy", "k1"),
    "RADIAL_FISHEYE": ("f", "cx", "cy", "k1", "k2"),
    "THIN_PRISM_FISHEYE": ("fx", "fy", "cx", "cy", "k1", "k2", "p1", "p2", "k3", "k4", "sx1", "sy1"),
    "SIMPLE_FISHEYE": ("f", "cx", "cy"),
    "FISHEYE": ("fx", "fy", "cx", "cy"),
}
MODEL_IDS = {name: number for number, name in enumerate(COLMAP_MODELS) if name in MODEL_PARAMETERS}
# Of a photo that shows all directions, twice as wide as high; it has no parameters. It is cut into views before use
# (`biresnerf.data.photos.panoramas.cut_panoramas`), so nothing that projects knows it.
PANORAMA = "EQUIRECTANGULAR"
FISHEYE_MODELS = frozenset(name for name in MODEL_PARAMETERS if name.endswith("FISHEYE"))
# If the requested model cannot represent a camera, the first of these that can is used; those of one focal length where
# the requested one has one.
_ONE_FOCAL = ("SIMPLE_RADIAL", "RADIAL", "RADIAL_FISHEYE")
_FALLBACKS = ("PINHOLE", "OPENCV", "FULL_OPENCV", "OPENCV_FISHEYE", "THIN_PRISM_FISHEYE")


COEFFICIENTS = ("k1", "k2", "p1", "p2", "k3", "k4", "k5", "k6", "sx1", "sy1")


class FullParameters(NamedTuple):
    """Any supported model, written out in full. Pixels, and coefficients without unit.

    k3 and k4 mean one thing in a perspective lens (FULL_OPENCV) and another in a fisheye (OPENCV_FISHEYE).
    """

    fx: float
    fy: float
    cx: float
    cy: float
    k1: float = 0.0
    k2: float = 0.0
    p1: float = 0.0
    p2: float = 0.0
    k3: float = 0.0
    k4: float = 0.0
    k5: float = 0.0
    k6: float = 0.0
    sx1: float = 0.0
    sy1: float = 0.0
    fisheye: bool = False

    @property
    def distorted(self) -> bool:
        """Whether any coefficient differs from zero. A fisheye without coefficients is the equidistant lens."""
        return any(getattr(self, name) for name in COEFFICIENTS)


def full_parameters(model: str, params: Sequence[float]) -> FullParameters:
    """The parameters of ``model`` (COLMAP name and order) written out in full.

    Raises:
        ValueError: the model is not supported, or the number of parameters is not the model's.
    """
    if model not in MODEL_PARAMETERS:
        raise ValueError(f"camera model {model!r} is not one of {', '.join(MODEL_PARAMETERS)}")
    names = MODEL_PARAMETERS[model]
    if len(params) != len(names):
        raise ValueError(f"camera model {model} takes {len(names)} parameters, not {len(params)}")
    given = dict(zip(names, (float(p) for p in params), strict=True))
    if "f" in given:
        focal = given.pop("f")
        given |= {"fx": focal, "fy": focal}
    return FullParameters(**given, fisheye=model in FISHEYE_MODELS)


def smallest_model(full: FullParameters, preferred: str | None) -> tuple[str, tuple[float, ...]]:
    """``preferred`` where it holds ``full`` without loss, else one that does; with its parameters.

    Raises:
        ValueError: no model does: a fisheye with k5 or k6, or another lens with sx1 or sy1.
    """
    order: tuple[str, ...] = _FALLBACKS
    if preferred is not None:
        order = (preferred, *(_ONE_FOCAL if "f" in MODEL_PARAMETERS[preferred] else ()), *_FALLBACKS)
    model = next((name for name in order if _holds(name, full)), None)
    if model is None:
        raise ValueError("no camera model holds a fisheye lens with k5 or k6, or another one with sx1 or sy1")
    values = full._asdict() | {"f": full.fx}
    return model, tuple(values[name] for name in MODEL_PARAMETERS[model])


def _holds(model: str, full: FullParameters) -> bool:
    """Whether ``model`` is of the lens's family and has a place for all that is not zero in it."""
    names = MODEL_PARAMETERS[model]
    if (model in FISHEYE_MODELS) != full.fisheye or ("f" in names and full.fx != full.fy):
        return False
    return all(name in names for name in COEFFICIENTS if getattr(full, name) != 0.0)


@dataclass(frozen=True)
class Camera:
    """Intrinsics: COLMAP model name, image size (px) and parameters in COLMAP's order.

    Pixels; the centre of the first pixel lies at (0.5, 0.5).

    Attributes:
        shear: of a camera with skew. Its model has none and describes the photo once that is straightened: what is at
            (x, y) then is at (x + shear (y - height / 2), y) in the file.
    """

    model: str
    width: int
    height: int
    params: tuple[float, ...]
    shear: float = 0.0

    @property
    def panorama(self) -> bool:
        """Whether it is none with a lens: the photo shows all directions, forward in its middle."""
        return self.model == PANORAMA

    def full(self) -> FullParameters:
        """These intrinsics with all coefficients written out, and whether they are a fisheye's."""
        return full_parameters(self.model, self.params)

    def resized(self, width: int, height: int) -> Camera:
        """The camera of the same picture resampled to ``width`` x ``height`` px.

        The true ratios are used, so a model with one focal length may have to become one with two.
        """
        if self.panorama:
            return Camera(PANORAMA, width, height, ())
        a, b = width / self.width, height / self.height
        p = self.full()
        scaled = p._replace(fx=p.fx * a, fy=p.fy * b, cx=p.cx * a, cy=p.cy * b)
        model, params = smallest_model(scaled, self.model)
        return Camera(model, width, height, params, self.shear * a / b)
