"""COLMAP's camera models that this project supports, as plain numbers (needs no torch).

Two families. The perspective one is a special case of FULL_OPENCV: two focal lengths, a principal point, radial
coefficients of a rational function (k1 to k3 above, k4 to k6 below) and two tangential ones (p1, p2). The fisheye
one is a special case of THIN_PRISM_FISHEYE: k1 to k4 are the coefficients of a polynomial in the angle from the axis,
sx1 and sy1 those of a thin prism. Other lenses are carried by a member of one of them (`carried_lenses`).
Lengths are in pixels; the centre of the first pixel lies at (0.5, 0.5).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import lru_cache
from math import hypot
from typing import NamedTuple

from biresnerf.geometry.camera.carried_lenses import (
    SHAPES,
    Carrier,
    Curve,
    carrier_of,
    fitted_curve,
    nearest_shape,
)

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
    "FOV": ("fx", "fy", "cx", "cy", "omega"),
    "SIMPLE_DIVISION": ("f", "cx", "cy", "k"),
    "DIVISION": ("fx", "fy", "cx", "cy", "k"),
    "EUCM": ("fx", "fy", "cx", "cy", "alpha", "beta"),
}
# What may be refined of a lens, as its family calls it: of a carried one, as many coefficients as its shape has.
REFINED_PARAMETERS = MODEL_PARAMETERS | {
    model: MODEL_PARAMETERS[model][: -len(shape)] + ("k1", "k2")[: len(shape)]
    for model, shape in SHAPES.items()
}
MODEL_IDS = {name: number for number, name in enumerate(COLMAP_MODELS) if name in MODEL_PARAMETERS}
# Of a photo that shows all directions, twice as wide as high; it has no parameters. It is cut into views before use
# (`biresnerf.data.photos.panoramas.cut_panoramas`), so nothing that projects knows it.
PANORAMA = "EQUIRECTANGULAR"
# Those of the two families, without the carried ones.
FAMILY_MODELS = tuple(name for name in MODEL_PARAMETERS if name not in SHAPES)
FISHEYE_MODELS = frozenset(name for name in FAMILY_MODELS if name.endswith("FISHEYE"))
# If the requested model cannot represent a camera, the first of these that can is used; those of one focal length where
# the requested one has one.
_ONE_FOCAL = ("SIMPLE_RADIAL", "RADIAL", "RADIAL_FISHEYE")
_FALLBACKS = ("PINHOLE", "OPENCV", "FULL_OPENCV", "OPENCV_FISHEYE", "THIN_PRISM_FISHEYE")


COEFFICIENTS = ("k1", "k2", "p1", "p2", "k3", "k4", "k5", "k6", "sx1", "sy1", "b1", "b2", "b3")
# How far a carrier may show anything from where its lens does, as a share of the photo's longer side: 0.05 px of 1000.
# A feature is found to some 0.3 px.
MOST_APART = 5e-5
# A refined lens gets its own formula again if the misfit is no more than this share of the refinement's change.
MISSED_SHARE = 0.1


class FullParameters(NamedTuple):
    """Any supported model, written out in full. Pixels, and coefficients without unit.

    k3 and k4 mean one thing in a perspective lens (FULL_OPENCV) and another in a fisheye (OPENCV_FISHEYE). b1 to b3
    are a fisheye's denominator, which only the carrier of another lens has.
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
    b1: float = 0.0
    b2: float = 0.0
    b3: float = 0.0
    fisheye: bool = False

    @property
    def distorted(self) -> bool:
        """Whether any coefficient differs from zero. A fisheye without coefficients is the equidistant lens."""
        return any(getattr(self, name) for name in COEFFICIENTS)


def full_parameters(model: str, params: Sequence[float]) -> FullParameters:
    """The parameters of ``model`` (COLMAP name and order) written out in full.

    Raises:
        ValueError: the model is of neither family, or the number of parameters is not the model's.
    """
    if model not in FAMILY_MODELS:
        raise ValueError(f"camera model {model!r} is not one of {', '.join(FAMILY_MODELS)}")
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
        ValueError: no model does: a fisheye with k5, k6 or a denominator, or another lens with sx1 or sy1.
    """
    order: tuple[str, ...] = _FALLBACKS
    if preferred is not None:
        order = (preferred, *(_ONE_FOCAL if "f" in MODEL_PARAMETERS[preferred] else ()), *_FALLBACKS)
    model = next((name for name in order if _holds(name, full)), None)
    if model is None:
        raise ValueError(
            "no camera model holds a fisheye lens with k5, k6 or b1, or another one with sx1 or sy1"
        )
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
        """Whether the photo is a panorama, without a lens: it shows all directions, forward in its middle."""
        return self.model == PANORAMA

    def full(self) -> FullParameters:
        """These intrinsics with all coefficients written out, and whether they are a fisheye's.

        Raises:
            ValueError: no lens; or one of another formula that shows nothing in the photo's corners, or that neither
                family matches.
        """
        return _carried(self)[0] if self.model in SHAPES else full_parameters(self.model, self.params)

    def with_lens(self, lens: FullParameters) -> Camera:
        """This camera with another lens, in its own model where that holds it, else in the smallest that does.

        A carried lens keeps its model where one of its kind shows nearly the same as `lens`.
        """
        if self.model not in SHAPES:
            model, params = smallest_model(lens, self.model)
            return replace(self, model=model, params=params)
        same = _of_the_same_kind(self, lens)
        if same is not None:
            return same
        if lens.b1 or lens.b2 or lens.b3:
            angles = _carried(self)[1].angles
            shown = _curve_of(lens).at(angles) / lens.fx
            lens = _with_curve(lens, fitted_curve(angles, shown, 4, 0, fisheye=True))
        model, params = smallest_model(lens, None)
        return replace(self, model=model, params=params)

    def resized(self, width: int, height: int) -> Camera:
        """The camera of the same picture resampled to ``width`` x ``height`` px.

        The true ratios are used, so a model with one focal length may have to become one with two.
        """
        if self.panorama:
            return Camera(PANORAMA, width, height, ())
        a, b = width / self.width, height / self.height
        if self.model in SHAPES:
            fx, fy, cx, cy, shape = _own(self)
            model, params = of_shape(self.model, fx * a, fy * b, cx * a, cy * b, shape)
            return Camera(model, width, height, params, self.shear * a / b)
        p = self.full()
        scaled = p._replace(fx=p.fx * a, fy=p.fy * b, cx=p.cx * a, cy=p.cy * b)
        model, params = smallest_model(scaled, self.model)
        return Camera(model, width, height, params, self.shear * a / b)


def of_shape(
    model: str, fx: float, fy: float, cx: float, cy: float, shape: Sequence[float]
) -> tuple[str, tuple[float, ...]]:
    """Name and parameters of a carried model; that with two focal lengths where they differ."""
    if model.startswith("SIMPLE_") and fx == fy:
        return model, (fx, cx, cy, *shape)
    return model.removeprefix("SIMPLE_"), (fx, fy, cx, cy, *shape)


@lru_cache(maxsize=1024)
def _carried(camera: Camera) -> tuple[FullParameters, Carrier]:
    """The member of a family that carries a camera's lens, and how far it is from it."""
    fx, fy, cx, cy, shape = _own(camera)
    width, height = camera.width, camera.height
    carrier = carrier_of(camera.model, shape, hypot(max(cx, width - cx) / fx, max(cy, height - cy) / fy))
    apart = carrier.apart * max(fx, fy)
    if not apart <= MOST_APART * max(width, height):
        raise ValueError(
            f"this {camera.model} lens is {apart:.2g} px from any lens that can be computed with"
        )
    return _with_curve(FullParameters(fx, fy, cx, cy), carrier.curve), carrier


def _own(camera: Camera) -> tuple[float, float, float, float, tuple[float, ...]]:
    """Both focal lengths, the principal point and the shape of a lens that is carried."""
    params, count = camera.params, len(SHAPES[camera.model])
    fy, cx, cy = params[-count - 3 : -count]  # fy is f where there is but one
    return params[0], fy, cx, cy, params[-count:]


def _with_curve(lens: FullParameters, curve: Curve) -> FullParameters:
    """A lens with another curve, of its focal lengths."""
    above, below = (*curve.above, 0.0)[:4], (*curve.below, 0.0, 0.0, 0.0)[:3]
    named = dict(zip(("k1", "k2", "k3", "k4"), above, strict=True))
    named |= dict(zip(("b1", "b2", "b3") if curve.fisheye else ("k4", "k5", "k6"), below, strict=True))
    return lens._replace(fx=lens.fx * curve.focal, fy=lens.fy * curve.focal, fisheye=curve.fisheye, **named)


def _curve_of(lens: FullParameters) -> Curve:
    """The curve of a lens, in pixels along x."""
    if lens.fisheye:
        return Curve(lens.fx, (lens.k1, lens.k2, lens.k3, lens.k4), (lens.b1, lens.b2, lens.b3), True)
    return Curve(lens.fx, (lens.k1, lens.k2, lens.k3), (lens.k4, lens.k5, lens.k6), False)


def _of_the_same_kind(camera: Camera, lens: FullParameters) -> Camera | None:
    """The camera with the lens of its own formula that is nearest to `lens`; None where that is too far from it."""
    (given, carrier), (fx, fy, _, _, shape) = _carried(camera), _own(camera)
    if lens.p1 or lens.p2 or lens.sx1 or lens.sy1 or lens.fisheye != given.fisheye:
        return None
    before, after = _curve_of(given), _curve_of(lens)
    focal, other = fx * (lens.fx / given.fx), fy * (lens.fy / given.fy)
    if before._replace(focal=after.focal) != after:
        focal, shape, away = nearest_shape(camera.model, shape, carrier.angles, after.at(carrier.angles))
        moved = float(abs(after.at(carrier.angles) - before.at(carrier.angles)).max())
        if not away <= max(MISSED_SHARE * moved, MOST_APART * max(camera.width, camera.height)):
            return None
        other = focal * (lens.fy / lens.fx)
    model, params = of_shape(camera.model, focal, other, lens.cx, lens.cy, shape)
    found = replace(camera, model=model, params=params)
    try:
        found.full()
    except ValueError:
        return None
    return found
