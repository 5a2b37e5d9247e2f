"""A field whose density is a formula."""

from __future__ import annotations

from collections.abc import Callable

import torch
from torch import Tensor

from biresnerf.field.radiance_field import (
    FieldRates,
    Marching,
    PositionGradient,
    RadianceField,
    Rays,
    Rendering,
)
from biresnerf.field.reference import operations as reference


class AnalyticField(RadianceField):
    """Grey, with the density that `formula` gives at points [n, 3] of the unit frame's inner box."""

    backend = "analytic"

    def __init__(self, formula: Callable[[Tensor], Tensor], *, unbounded: bool) -> None:
        self.formula, self.unbounded = formula, unbounded

    def density(self, position: Tensor) -> Tensor:
        return self.formula(position * 4 - 2 if self.unbounded else position * 2 - 1)

    def render(self, rays: Rays, marching: Marching, gradient: PositionGradient) -> Rendering:
        t, dt, ray = reference.march(
            rays.origin, rays.direction, rays.jitter, marching.occupied,
            marching.step, marching.near, marching.far, self.unbounded, marching.most,
        )  # fmt: skip
        density = self.formula(rays.origin[ray] + t[:, None] * rays.direction[ray])
        grey = torch.full((len(t), 3), 0.5)
        rgb, opacity, depth = reference.composite(density, grey, t, dt, ray, rays.background)
        return Rendering(rgb, opacity, depth, len(t))

    def step(self, rates: FieldRates) -> None:
        raise NotImplementedError

    def discard_gradients(self) -> None:
        raise NotImplementedError

    def state(self) -> dict[str, Tensor]:
        raise NotImplementedError

    def load_state(self, state: dict[str, Tensor]) -> None:
        raise NotImplementedError

    def reach(self, progress: float) -> None:
        raise NotImplementedError
