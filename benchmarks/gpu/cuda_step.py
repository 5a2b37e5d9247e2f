"""One optimisation step of the field on a GPU: the Triton kernels against the plain-torch definition.

``python -m benchmarks.gpu.cuda_step`` prints a JSON line for each stage; with ``--profile``, where a step's time goes.
To find what fails: ``--alone kernels`` and ``--alone plain`` take steps of one field only, and with ``--waiting`` the
host waits for each kernel.
"""

from __future__ import annotations

import argparse
import json
import statistics
import time
from collections.abc import Iterator

import torch

from biresnerf.field.cuda.field import CudaField
from biresnerf.field.cuda.launches import Launch, Plan
from biresnerf.field.grid_levels import grid_levels
from biresnerf.field.radiance_field import (
    FieldRates,
    FieldShape,
    Marching,
    PositionGradient,
    RadianceField,
    Rays,
)
from biresnerf.field.reference.field import ReferenceField

LEVELS, SIDE = 16, 128
DEVICE = torch.device("cuda")
SHAPE = FieldShape(grid_levels(3, 16, 72, 22), grid_levels(LEVELS, 128, 4096, 19), unbounded=False)
ALONE = {"kernels": CudaField, "plain": ReferenceField}


def _rays(count: int) -> Rays:
    direction = torch.nn.functional.normalize(torch.randn(count, 3, device=DEVICE), dim=1)
    origin = (torch.rand(count, 3, device=DEVICE) - 0.5) * 0.6 - 2.6 * direction
    return Rays(
        origin.requires_grad_(),
        direction.requires_grad_(),
        torch.ones(count, 3, device=DEVICE),
        torch.rand(count, device=DEVICE),
        count,
    )


def _shell() -> torch.Tensor:
    """An occupancy grid that is live in a spherical shell: about 40 samples a ray, as after pruning."""
    centre = (torch.arange(SIDE, device=DEVICE) + 0.5) / SIDE - 0.5
    z, y, x = torch.meshgrid(centre, centre, centre, indexing="ij")
    return (((x * x + y * y + z * z).sqrt() - 0.33).abs() < 0.02).to(torch.uint8)


def _steps(field: RadianceField, rays: int, steps: int, occupied: torch.Tensor) -> tuple[float, int]:
    """Seconds per step, with the host free to run ahead as in a run, and the samples of the last step."""
    batch, marching, samples = _rays(rays), Marching(3.3e-3, 0.1, 12.0, 768, occupied), 0
    torch.cuda.synchronize()
    started = time.perf_counter()
    for _ in range(steps):
        rendering = field.render(batch, marching, PositionGradient(1.0, 1.0, 1.0))
        ((rendering.colour - 0.3) ** 2).mean().backward()
        field.step(FieldRates(1e-4, 1e-4, (1e-4,) * LEVELS, 1e-4))
        samples = rendering.samples
    torch.cuda.synchronize()
    return (time.perf_counter() - started) / steps, samples


def run(rays: int, rounds: int) -> Iterator[dict[str, float | str | int]]:
    """A row for each stage at the paper's encodings (Table 1), T = 2^19: medians, measured alternately."""
    kernels, plain = (field(SHAPE, 0, DEVICE) for field in ALONE.values())
    occupied = _shell()
    for stage in ("coarse", "fine"):
        if stage == "fine":
            kernels.start_reconstruction()
            plain.start_reconstruction()
        for field in (kernels, plain):
            _steps(field, rays, 3, occupied)
        pairs = [
            (_steps(kernels, rays, 50, occupied), _steps(plain, rays, 2, occupied)) for _ in range(rounds)
        ]
        yield {
            "stage": f"{stage} cuda",
            "samples": pairs[-1][1][1],
            "kernels_ms": 1e3 * statistics.median(fast for (fast, _), _ in pairs),
            "torch_ms": 1e3 * statistics.median(slow for _, (slow, _) in pairs),
            "ratio": statistics.median(slow / fast for (fast, _), (slow, _) in pairs),
            "kernels_ns_per_sample": 1e9 * statistics.median(fast / n for (fast, n), _ in pairs),
        }


def run_alone(name: str, rays: int, steps: int) -> Iterator[dict[str, str | int]]:
    """A row for each stage, so that a fault is that of this field."""
    field = ALONE[name](SHAPE, 0, DEVICE)
    for stage in ("coarse", "fine"):
        if stage == "fine":
            field.start_reconstruction()
        for done in range(0, steps, 20):
            _, samples = _steps(field, rays, 20, _shell())
            yield {"field": name, "stage": stage, "steps": done + 20, "samples": samples}


def wait_for_each_launch() -> None:
    """Wait after each launch, so that a fault shows at its kernel. Records no graphs."""
    launch_alone = Launch.__call__

    def launch_and_wait(launch: Launch) -> None:
        try:
            launch_alone(launch)
            torch.cuda.synchronize()
        except RuntimeError as error:
            shapes = {name: getattr(value, "shape", value) for name, value in launch.arguments.items()}
            print(
                f"{launch.kernel.fn.__name__} {launch.grid}: {str(error).splitlines()[0]}\n{shapes}",
                flush=True,
            )
            raise

    Launch.__call__ = launch_and_wait  # type: ignore[method-assign]
    Plan.record = lambda plan: None  # type: ignore[method-assign]


def profile(rays: int) -> str:
    """The kernels of stage 2 by device time, from torch's profiler over 20 steps."""
    from torch.profiler import ProfilerActivity
    from torch.profiler import profile as watch

    field, occupied = CudaField(SHAPE, 0, DEVICE), _shell()
    field.start_reconstruction()
    _steps(field, rays, 3, occupied)
    with watch(activities=[ProfilerActivity.CPU, ProfilerActivity.CUDA]) as seen:
        _steps(field, rays, 20, occupied)
    return seen.key_averages().table(sort_by="cuda_time_total", row_limit=25)


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--profile", action="store_true")
    parser.add_argument("--waiting", action="store_true")
    parser.add_argument("--alone", choices=tuple(ALONE))
    asked = parser.parse_args()
    if asked.waiting:
        wait_for_each_launch()
    torch.manual_seed(0)
    if asked.alone:
        for row in run_alone(asked.alone, 8192, 200):
            print(json.dumps(row), flush=True)
    elif asked.profile:
        print(profile(8192))
    else:
        for row in run(8192, 5):
            print(json.dumps(row), flush=True)
