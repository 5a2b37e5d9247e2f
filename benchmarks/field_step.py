"""One optimisation step of the field (render, backward, Adam): the CPU kernels against the plain-torch definition."""

from __future__ import annotations

import statistics
import time
from dataclasses import asdict, dataclass

import torch

from biresnerf.field.backends import use_threads
from biresnerf.field.cpu_field import CpuField
from biresnerf.field.grid_levels import grid_levels
from biresnerf.field.radiance_field import (
    FieldRates,
    FieldShape,
    Marching,
    PositionGradient,
    RadianceField,
    Rays,
)
from biresnerf.field.reference_field import ReferenceField

LEVELS = 16
SIDE = 128


@dataclass(frozen=True)
class Row:
    """Medians of one stage; the ratio is taken round by round, so that a drifting machine cancels."""

    stage: str
    samples: int
    kernels_ms: float
    torch_ms: float
    ratio: float
    kernels_ns_per_sample: float


def _shell() -> torch.Tensor:
    """An occupancy grid that is live in a spherical shell: about 40 samples a ray, as after pruning."""
    centre = (torch.arange(SIDE) + 0.5) / SIDE - 0.5
    z, y, x = torch.meshgrid(centre, centre, centre, indexing="ij")
    radius = (x * x + y * y + z * z).sqrt()
    return ((radius - 0.33).abs() < 0.02).to(torch.uint8)


def _step(field: RadianceField, rays: int, occupied: torch.Tensor, seed: int) -> tuple[float, int]:
    generator = torch.Generator().manual_seed(seed)
    direction = torch.nn.functional.normalize(torch.randn(rays, 3, generator=generator), dim=1)
    origin = (torch.rand(rays, 3, generator=generator) - 0.5) * 0.6 - 2.6 * direction
    batch = Rays(
        origin.requires_grad_(),
        direction.requires_grad_(),
        torch.ones(rays, 3),
        torch.rand(rays, generator=generator),
        rays,
    )
    # The plain-torch step is given all cores, the kernels leave torch one.
    torch.set_num_threads(1 if field.backend == "cpu" else _threads)
    started = time.perf_counter()
    rendering = field.render(
        batch, Marching(3.3e-3, 0.1, 12.0, 768, occupied), PositionGradient(1.0, 1.0, 1.0)
    )
    ((rendering.colour - 0.3) ** 2).mean().backward()
    field.step(FieldRates(1e-4, 1e-4, (1e-4,) * LEVELS, 1e-4))
    return time.perf_counter() - started, rendering.samples


_threads = 1


def run(rays: int, rounds: int) -> list[dict[str, float | str | int]]:
    """Rows for stage 1 and stage 2 at the paper's encodings (Table 1), T = 2^19."""
    global _threads
    _threads = use_threads(0)
    shape = FieldShape(grid_levels(3, 16, 72, 22), grid_levels(LEVELS, 128, 4096, 19), unbounded=False)
    device = torch.device("cpu")
    kernels, plain = CpuField(shape, 0, device, _threads), ReferenceField(shape, 0, device)
    occupied, rows = _shell(), []
    for stage in ("coarse", "fine"):
        if stage == "fine":
            kernels.start_reconstruction()
            plain.start_reconstruction()
        for warm in range(3):
            _step(kernels, rays, occupied, warm)
        _step(plain, rays, occupied, 0)
        pairs = []
        for seed in range(rounds):
            _step(kernels, rays, occupied, seed)  # wakes the threads that the torch step has put to sleep
            fast, samples = _step(kernels, rays, occupied, seed)
            slow, _ = _step(plain, rays, occupied, seed)
            pairs.append((fast, slow))
        fast = statistics.median(f for f, _ in pairs)
        slow = statistics.median(s for _, s in pairs)
        ratio = statistics.median(s / f for f, s in pairs)
        rows.append(asdict(Row(stage, samples, 1e3 * fast, 1e3 * slow, ratio, 1e9 * fast / samples)))
    return rows
