"""A field that can be recorded and costs nothing: one colour along each ray, in plain torch."""

from __future__ import annotations

from typing import ClassVar

import torch
from torch import Tensor

from biresnerf.field.adam import Adam
from biresnerf.field.grid_levels import grid_levels
from biresnerf.field.radiance_field import (
    FieldRates,
    FieldShape,
    Marching,
    PositionGradient,
    Rays,
    RecordableField,
    Rendering,
)


class OneColourField(RecordableField):
    """Colours are a function of six weights, the ray, and the numbers of a pass, which lie in memory."""

    backend, unbounded, recordable, place = "one colour", False, True, 0
    SHAPE: ClassVar = FieldShape(grid_levels(2, 4, 8, 9), grid_levels(3, 8, 16, 9), unbounded=False)

    def __init__(self) -> None:
        self.shape = self.SHAPE
        self.weights = torch.linspace(-1, 1, 6).reshape(2, 3).requires_grad_()
        self._adam = Adam([self.weights])
        self._numbers = torch.zeros(2)
        self._rays = self._samples = 0

    def prepare(
        self, rays: int, trained: int, marching: Marching, gradient: PositionGradient, rates: FieldRates
    ) -> int:
        self._numbers.copy_(torch.tensor([marching.near, marching.step]))
        self._rays = rays
        return 50 * rays

    def render_prepared(self, rays: Rays) -> Rendering:
        at = rays.origin + rays.direction * (self._numbers[0] + self._numbers[1] * rays.jitter[:, None])
        colour = torch.sigmoid(at * self.weights[0] + self.weights[1] + rays.background)
        return Rendering(colour, colour.mean(1), at[:, 2].detach(), 50 * len(at))

    def step_prepared(self, rates: FieldRates) -> None:
        self._adam.step(rates.networks)
        self.discard_gradients()

    def finish(self) -> None:
        self._samples += 50 * self._rays

    def render(self, rays: Rays, marching: Marching, gradient: PositionGradient) -> Rendering:
        raise AssertionError("every step is foreseen")

    def step(self, rates: FieldRates) -> None:
        raise AssertionError("every step is foreseen")

    def density(self, position: Tensor) -> Tensor:
        return position.sum(1)

    def discard_gradients(self) -> None:
        self._adam.zero_grad()

    def start_reconstruction(self) -> None:
        pass

    def reach(self, progress: float) -> None:
        pass

    def state(self) -> dict[str, Tensor]:
        counters = torch.tensor([self._samples])
        return {"weights": self.weights.detach(), "counters": counters, **self._adam.state("adam")}

    def load_state(self, state: dict[str, Tensor]) -> None:
        with torch.no_grad():
            self.weights.copy_(state["weights"])
        self._adam.load_state("adam", state)
