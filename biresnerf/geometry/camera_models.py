"""COLMAP's camera models that this project supports, as plain numbers (needs no torch).

All of them are special cases of OPENCV: two focal lengths, a principal point, two radial coefficients (k1,
k2) and two tangential ones (p1, p2). Lengths are in pixels; the centre of the first pixel lies at (0.5, 0.5).
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

# COLMAP's ids and parameter names, in COLMAP's order (src/colmap/sensor/models.h).
MODEL_IDS: dict[str, int] = {
    "SIMPLE_PINHOLE": 0,
    "PINHOLE": 1,
    "SIMPLE_RADIAL": 2,
    "RADIAL": 3,
    "OPENCV": 4,
}
MODEL_PARAMETERS: dict[str, tuple[str, ...]] = {
    "SIMPLE_PINHOLE": ("f", "cx", "cy"),
    "PINHOLE": ("fx", "fy", "cx", "cy"),
    "SIMPLE_RADIAL": ("f", "cx", "cy", "k1"),
    "RADIAL": ("f", "cx", "cy", "k1", "k2"),
    "OPENCV": ("fx", "fy", "cx", "cy", "k1", "k2", "p1", "p2"),
}


class OpenCVParameters(NamedTuple):
    """Any supported model, written out in full. Pixels, and coefficients without unit."""

    fx: float
    fy: float
    cx: float
    cy: float
    k1: float = 0.0
    k2: float = 0.0
    p1: float = 0.0
    p2: float = 0.0


def full_parameters(model: str, params: Sequence[float]) -> OpenCVParameters:
    """The parameters of ``model`` (COLMAP name and order) as the full OPENCV model.

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
    return OpenCVParameters(**given)


def smallest_model(full: OpenCVParameters, preferred: str) -> tuple[str, tuple[float, ...]]:
    """``preferred`` where it holds ``full`` without loss, else PINHOLE or OPENCV; with its parameters."""
    one_focal = full.fx == full.fy
    pinhole = full.k1 == full.k2 == full.p1 == full.p2 == 0.0
    fits = {
        "SIMPLE_PINHOLE": one_focal and pinhole,
        "PINHOLE": pinhole,
        "SIMPLE_RADIAL": one_focal and full.k2 == full.p1 == full.p2 == 0.0,
        "RADIAL": one_focal and full.p1 == full.p2 == 0.0,
        "OPENCV": True,
    }
    model = preferred if fits[preferred] else ("PINHOLE" if pinhole else "OPENCV")
    values = full._asdict() | {"f": full.fx}
    return model, tuple(values[name] for name in MODEL_PARAMETERS[model])
