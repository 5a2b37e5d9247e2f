"""The field of BARF (Lin et al. 2021): one large network of positional encodings, in plain torch on any device.

Lengths inside are BARF's: one unit is a quarter of the cameras' distance, so that its frequencies and densities
mean what they mean there. Rays are sampled in strata, as BARF does, or marched through the occupancy grid with
white behind, as its version on NerfAcc does.
"""

from __future__ import annotations

import math

import torch
from torch import Tensor
from torch.nn.functional import relu, softplus

from biresnerf.field.adam import Adam
from biresnerf.field.coarse_to_fine import band_weights
from biresnerf.field.radiance_field import (
    FieldRates,
    Marching,
    PositionGradient,
    RadianceField,
    Rays,
    Rendering,
)
from biresnerf.field.reference import operations as reference

LAYERS, SKIP = 8, 4
POSITION_BANDS, VIEW_BANDS = 10, 4
LAST_INTERVAL = 1e10  # BARF's last sample reaches to infinity: it learns the background
CHUNK = 1 << 16  # samples evaluated at once where no gradient is kept


def positional_encoding(x: Tensor, bands: int, progress: float) -> Tensor:
    """x [n, 3] and the sines and cosines of 2^k pi x, k < bands, weighted from coarse to fine: [n, 3 + 6 bands]."""
    frequency = math.pi * 2.0 ** torch.arange(bands, dtype=x.dtype, device=x.device)
    weight = torch.as_tensor(band_weights(progress, bands), dtype=x.dtype, device=x.device)
    phase = x[:, :, None] * frequency
    waves = torch.stack([phase.sin(), phase.cos()], 2) * weight
    return torch.cat([x, waves.flatten(1)], 1)


class MlpField(RadianceField):
    """Backend `torch`.

    Args:
        hidden: units of a layer; half as many before the colour.
        length: one unit of length inside, in units of the unit frame.
        stratified: samples per ray, or None to march through the occupancy grid.
    """

    backend = "torch"

    def __init__(
        self,
        seed: int,
        device: torch.device,
        *,
        hidden: int,
        unbounded: bool,
        length: float,
        stratified: int | None,
    ) -> None:
        self.device, self.unbounded, self.length, self.stratified = device, unbounded, length, stratified
        self.progress = 0.0
        generator = torch.Generator().manual_seed(seed)
        position, view = 3 + 6 * POSITION_BANDS, 3 + 6 * VIEW_BANDS
        self.parameters: list[Tensor] = []  # weight and bias of each layer, position network first

        def layer(rows: int, columns: int, plain_rows: int = 0) -> None:
            """Xavier's bound, sqrt(2) larger before a rectifier; `plain_rows` outputs have none behind them."""
            bound = torch.full((rows, 1), math.sqrt(12 / (rows - plain_rows + columns)))
            bound[:plain_rows] = math.sqrt(6 / (plain_rows + columns))
            weight = (torch.rand(rows, columns, generator=generator) * 2 - 1) * bound
            self.parameters += [weight.to(device), torch.zeros(rows, device=device)]

        for i in range(LAYERS):
            columns = position if i == 0 else hidden + position * (i == SKIP)
            last = i == LAYERS - 1
            layer(hidden + last, columns, plain_rows=int(last))
        layer(hidden // 2, hidden + view)
        layer(3, hidden // 2, plain_rows=3)
        for parameter in self.parameters:
            parameter.requires_grad_()
        self._adam = Adam(self.parameters)

    def network(self, x: Tensor, view: Tensor, parameters: list[Tensor]) -> tuple[Tensor, Tensor]:
        """Density [n] per unit of the unit frame and colour [n, 3] at x [n, 3], seen along unit `view` [n, 3]."""
        outputs = self._outputs(x, parameters)
        seen = positional_encoding(view, VIEW_BANDS, self.progress)
        w1, b1, w2, b2 = parameters[2 * LAYERS :]
        hidden = relu(torch.cat([relu(outputs[:, 1:]), seen], 1) @ w1.T + b1)
        return softplus(outputs[:, 0]) / self.length, torch.sigmoid(hidden @ w2.T + b2)

    def _outputs(self, x: Tensor, parameters: list[Tensor]) -> Tensor:
        encoded = positional_encoding(x / self.length, POSITION_BANDS, self.progress)
        h = encoded
        for i in range(LAYERS):
            if i == SKIP:
                h = torch.cat([h, encoded], 1)
            h = h @ parameters[2 * i].T + parameters[2 * i + 1]
            if i < LAYERS - 1:
                h = relu(h)
        return h

    def _query(self, x: Tensor, view: Tensor, trained: int) -> tuple[Tensor, Tensor]:
        """The network; only the first `trained` samples give gradients to its parameters."""
        if not torch.is_grad_enabled():
            parts = [
                self.network(a, b, self.parameters)
                for a, b in zip(x.split(CHUNK), view.split(CHUNK), strict=True)
            ]
        else:
            frozen = [parameter.detach() for parameter in self.parameters]
            parts = [self.network(x[:trained], view[:trained], self.parameters)]
            if trained < len(x):
                parts.append(self.network(x[trained:], view[trained:], frozen))
        return torch.cat([p[0] for p in parts]), torch.cat([p[1] for p in parts])

    def _contracted(self, x: Tensor) -> Tensor:
        """Points [n, 3] of the unit frame as the network sees them, before the change of unit."""
        return 4 * reference.grid_position(x, True) - 2 if self.unbounded else x

    def render(self, rays: Rays, marching: Marching, gradient: PositionGradient) -> Rendering:
        if self.stratified is not None:
            return self._render_stratified(rays, marching, self.stratified)
        with torch.no_grad():
            t, dt, ray = reference.march(
                rays.origin, rays.direction, rays.jitter, marching.occupied,
                marching.step, marching.near, marching.far, self.unbounded, marching.most,
            )  # fmt: skip
        x = self._contracted(rays.origin[ray] + t[:, None] * rays.direction[ray])
        split = int((ray < rays.trained).sum())
        density, colour = self._query(x, rays.direction[ray], split)
        # Apart, so that not even the rounding of a sum takes anything from the other rays to the trained ones.
        parts = [
            reference.composite(density[s], colour[s], t[s], dt[s], ray[s] - first, rays.background[r])
            for s, r, first in (
                (slice(None, split), slice(None, rays.trained), 0),
                (slice(split, None), slice(rays.trained, None), rays.trained),
            )
        ]
        rgb, opacity, depth = (torch.cat(pair) for pair in zip(*parts, strict=True))
        return Rendering(rgb, opacity, depth.detach(), len(ray))

    def _render_stratified(self, rays: Rays, marching: Marching, bins: int) -> Rendering:
        """One sample of each of `bins` equal bins of depth, or of inverse depth where there are surroundings."""
        count = len(rays.origin)
        jitter = rays.jitter if rays.jitter.ndim == 2 else rays.jitter[:, None].expand(count, bins)
        u = (torch.arange(bins, device=self.device) + jitter) / bins
        near, far = marching.near, marching.far
        t = 1 / (1 / near + u * (1 / far - 1 / near)) if self.unbounded else near + u * (far - near)
        dt = torch.cat([t.diff(dim=1), torch.full_like(t[:, :1], LAST_INTERVAL)], 1)
        x = rays.origin[:, None] + t[:, :, None] * rays.direction[:, None]
        view = rays.direction[:, None].expand(count, bins, 3)
        density, colour = self._query(
            self._contracted(x.reshape(-1, 3)), view.reshape(-1, 3), rays.trained * bins
        )
        thickness = density.reshape(count, bins) * dt
        before = torch.cat([torch.zeros_like(thickness[:, :1]), thickness[:, :-1].cumsum(1)], 1)
        weight = torch.exp(-before) * (1 - torch.exp(-thickness))
        rgb = (weight[:, :, None] * colour.reshape(count, bins, 3)).sum(1)
        opacity = weight.sum(1)
        depth = (weight * t).sum(1) / opacity.clamp(min=1e-6)
        return Rendering(rgb, opacity, depth.detach(), count * bins)

    @torch.no_grad()
    def density(self, position: Tensor) -> Tensor:
        x = position * 4 - 2 if self.unbounded else position * 2 - 1
        parts = [softplus(self._outputs(part, self.parameters)[:, 0]) for part in x.split(CHUNK)]
        return torch.cat(parts) / self.length

    def reach(self, progress: float) -> None:
        self.progress = progress

    def step(self, rates: FieldRates) -> None:
        self._adam.step(rates.networks)
        self.discard_gradients()

    def discard_gradients(self) -> None:
        self._adam.zero_grad()

    def state(self) -> dict[str, Tensor]:
        state = {f"parameter{i}": parameter.detach() for i, parameter in enumerate(self.parameters)}
        return {**state, **self._adam.state("adam")}

    def load_state(self, state: dict[str, Tensor]) -> None:
        with torch.no_grad():
            for i, parameter in enumerate(self.parameters):
                parameter.copy_(state[f"parameter{i}"])
        self._adam.load_state("adam", state)
