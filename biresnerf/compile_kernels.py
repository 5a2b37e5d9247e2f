"""Compile all CPU kernels, or load them from Numba's cache: `python -m biresnerf.compile_kernels`.

A run compiles them in separate processes while it reads and matches photos (`KernelCompilation`). Compiling at install
time saves the first refinement a minute and a half of processor time.
"""

from __future__ import annotations

import hashlib
import subprocess
import sys
import time
from collections.abc import Callable
from contextlib import suppress
from functools import cache
from pathlib import Path
from typing import Self

import numba
import numpy as np
import torch
from numba.core import config

from biresnerf.data.points.tracks import Tracks
from biresnerf.field.backends import directions_for
from biresnerf.field.cpu.field import CpuField
from biresnerf.field.cpu.ray_kernels import add_harmonics_gradient, ray_gradients
from biresnerf.field.grid_levels import grid_levels
from biresnerf.field.radiance_field import FieldRates, FieldShape, Marching, Merging, PositionGradient, Rays
from biresnerf.field.spherical_harmonics import VIEW_FEATURES
from biresnerf.forecast.rates import cache_folder
from biresnerf.geometry.camera.camera import Intrinsics
from biresnerf.geometry.camera.camera_models import Camera
from biresnerf.refinement.adjustment.adjustment import adjust_poses, misfit
from biresnerf.refinement.adjustment.evidence import Evidence, PatchPhotos, PosePrior
from biresnerf.refinement.adjustment.patch_points import Surfaces, find_patches
from biresnerf.refinement.kernels.batches import add_errors, draw_pixels
from biresnerf.refinement.numbers.finish import EvidenceNumbers
from biresnerf.refinement.optimise.pixel_chances import PixelChances
from biresnerf.refinement.optimise.renderer import cast_rays, viewing_directions
from biresnerf.refinement.parameters.pose_parameters import PoseParameters

SIZE, BASELINE = 32, 0.125  # px, and as a share of the distance to the scene: four pixels
FIELD_RATES = FieldRates(1e-3, 1e-3, (1e-3,) * 2, 1e-3)


class KernelCompilation:
    """Compiles kernels in other processes and loads them from the cache. As a context, ends those processes.

    Attributes:
        waited_s: how long a run had to wait for kernels that are compiled once on a machine.
    """

    def __init__(self) -> None:
        self.waited_s = 0.0
        self._children: list[subprocess.Popen[bytes]] = []
        self._field = True

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        for child in self._children:
            child.kill()
            child.wait()

    def start(self, *, field: bool) -> bool:
        """Start compiling, the field's kernels only if ``field``; returns whether there is anything to compile."""
        self._field = field
        if _stamp(field).exists():
            return False
        for part in PARTS if field else ("adjustment",):
            command = [sys.executable, "-m", "biresnerf.compile_kernels", part]
            self._children.append(
                subprocess.Popen(command, stdin=subprocess.DEVNULL, stdout=subprocess.DEVNULL)
            )
        return True

    def finish(self, watch: Callable[[], None]) -> float:
        """Load the kernels once they are compiled; returns the seconds it took. ``watch`` is called while waiting.

        What the other processes could not compile is compiled here.
        """
        started = time.monotonic()
        watch()
        while any(child.poll() is None for child in self._children):
            time.sleep(0.1)
            watch()
        compile_kernels(field=self._field)
        seconds = time.monotonic() - started
        if self._children:
            self.waited_s = seconds
        return seconds


def compile_kernels(*, field: bool = True) -> None:
    """Compile every kernel of the adjustment, and those of the field if ``field``."""
    if field:
        compile_field_kernels()
        _cast_one_ray()
    _adjust_two_cameras()
    with suppress(
        OSError
    ):  # without room for it, the next run looks again whether there is something to compile
        _stamp(field).parent.mkdir(parents=True, exist_ok=True)
        _stamp(field).touch()


def _stamp(field: bool) -> Path:
    """The file that marks these kernels as compiled here, for this processor and from these sources."""
    target = (numba.__version__, sys.version, config.CPU_NAME, config.CPU_FEATURES)  # type: ignore[attr-defined]
    sources = sorted(
        (path.as_posix(), path.stat().st_mtime_ns) for path in Path(__file__).parent.rglob("*.py")
    )
    key = hashlib.sha256(repr((field, target, sources)).encode()).hexdigest()[:20]
    return Path(config.CACHE_DIR or cache_folder() / "kernels", f"compiled-{key}")  # type: ignore[attr-defined]


@cache  # once in a process
def compile_field_kernels() -> None:
    """Run every kernel once on a tiny field, as a step does."""
    field, colour = _render_one_ray()
    colour.sum().backward()
    field.step(FIELD_RATES)


def _render_one_ray() -> tuple[CpuField, torch.Tensor]:
    """A tiny field, and the colour of a ray through it."""
    field = _tiny_field()
    origin = torch.tensor([[0.0, 0.0, -2.0]], requires_grad=True)
    direction = torch.tensor([[0.0, 0.0, 1.0]], requires_grad=True)
    rays = Rays(origin, direction, torch.ones(1, 3), torch.zeros(1), trained=1)
    occupied = torch.ones(
        8, 8, 8, dtype=torch.uint8
    )  # of two blocks a side: of one, a reversed view is laid out alike
    marching = Marching(0.1, 0.1, 10.0, 64, occupied, Merging(light=0.03, most=8))
    colour = field.render(rays, marching, PositionGradient()).colour
    field.density(torch.full((1, 3), 0.5))
    return field, colour


def _tiny_field() -> CpuField:
    shape = FieldShape(grid_levels(2, 4, 8, 10), grid_levels(2, 16, 32, 10), unbounded=False)
    field = CpuField(shape, 0, torch.device("cpu"), workers=1)
    field.start_reconstruction()
    return field


def compile_backward_kernels() -> None:
    """Run the kernels of the field's backward pass and of its update, and none of its forward pass."""
    field, none = _tiny_field(), np.zeros((1, 3), np.float32)
    view, one = np.zeros((1, VIEW_FEATURES), np.float32), np.ones(1, np.float32)
    samples = field.unseen_sample()
    dx, g_view = field.render_backward(samples, view, none, one, none, one, PositionGradient())
    g_origin, g_direction = np.empty_like(none), np.empty_like(none)
    ray_gradients(none, none, samples.offset, samples.t, dx, field.shape.unbounded, g_origin, g_direction)
    add_harmonics_gradient(none, g_view, g_direction)
    field.step(FIELD_RATES)


@cache
def _cast_one_ray() -> None:
    """Cast the ray of one pixel of one photo, as a step does."""
    cpu = torch.device("cpu")
    photo, one, nowhere = np.zeros((1, 3), np.uint8), np.zeros(1, np.int64), np.zeros((1, 2), np.float32)
    colour, weight = np.zeros((1, 3), np.float32), np.zeros(1, np.float32)
    chances = PixelChances.of([photo[None]], [(1, 1)], [None], 0.0, cpu).arrays()
    draw_pixels(
        weight, nowhere, one, 1, chances, np.ones((1, 2), np.int64), one, photo, one, nowhere, colour, weight
    )
    add_errors(one, colour, colour, weight, weight, np.zeros((1, 3), np.float32))
    camera = torch.zeros(1, dtype=torch.int64)
    lens = Intrinsics.from_cameras([Camera("PINHOLE", SIZE, SIZE, (SIZE, SIZE, SIZE / 2, SIZE / 2))])
    in_cam = viewing_directions(directions_for(cpu), lens, camera, torch.ones(1, 2))
    _, direction = cast_rays(PoseParameters(torch.eye(4)[None], 1.0, cpu).matrices(), camera, in_cam)
    direction.sum().backward()


@cache
def _adjust_two_cameras() -> None:
    """Adjust two cameras side by side that look at a wall of vertical waves with tracked points."""
    poses = np.tile(np.eye(4), (2, 1, 1))
    poses[1, 0, 3] = BASELINE
    intrinsics = Intrinsics.from_cameras(
        [Camera("PINHOLE", SIZE, SIZE, (SIZE, SIZE, SIZE / 2, SIZE / 2))] * 2
    )
    x, y = np.meshgrid(*[(np.arange(SIZE) + 0.5) / SIZE - 0.5] * 2)
    photos = [np.repeat(0.5 + 0.4 * np.sin(20 * (x + shift))[..., None], 3, 2) for shift in (0.0, BASELINE)]
    seen = np.ones((SIZE, SIZE))
    surfaces = Surfaces([np.sqrt(1 + x**2 + y**2)] * 2, [seen] * 2, [seen > 0] * 2)
    stacked = PatchPhotos.stacked([p.astype(np.float32) for p in photos])
    patches = find_patches(poses, intrinsics, stacked, surfaces, 8, EvidenceNumbers())
    left = np.stack(np.meshgrid(*[np.linspace(8.0, 24.0, 6)] * 2), 2).reshape(-1, 2)
    xy = np.stack([left, left - [SIZE * BASELINE, 0]], 1).reshape(-1, 2)
    tracks = Tracks(np.repeat(np.arange(len(left)), 2), np.tile(np.arange(2), len(left)), xy)
    evidence = Evidence(intrinsics, tracks, patches)
    adjust_poses(poses, evidence, PosePrior.equal(poses, 0.02, 0.02))
    misfit(poses, evidence, 1.0)


def _step_back() -> None:
    """What a step runs beside rendering: its pixels' rays and the gradients."""
    compile_backward_kernels()
    _cast_one_ray()


# They take about equally long, and share few kernels.
PARTS: dict[str, Callable[[], object]] = {
    "render": _render_one_ray,
    "gradients": _step_back,
    "adjustment": _adjust_two_cameras,
}

if __name__ == "__main__":
    if len(sys.argv) > 1:
        PARTS[sys.argv[1]]()
    else:
        with KernelCompilation() as compilation:
            compilation.start(field=True)
            compilation.finish(lambda: None)
