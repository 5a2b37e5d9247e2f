"""Whether the kernels compute on this GPU what the plain-torch definition says: a small batch through both.

``python -m biresnerf.field.cuda.device_check`` prints what differs as a JSON list; `remembered_faults` asks it once for
each GPU, driver and version, in a process of its own, as a kernel that faults takes its process with it.
"""

from __future__ import annotations

import hashlib
import json
import logging
import os
import subprocess
import sys
from collections.abc import Callable
from functools import cache
from importlib.metadata import version
from pathlib import Path

import torch
from torch import Tensor

from biresnerf.field.cuda.lens import directions_in_cam as on_device
from biresnerf.field.grid_field import GridField
from biresnerf.field.grid_levels import grid_levels
from biresnerf.field.radiance_field import FieldRates, FieldShape, Marching, PositionGradient, Rays
from biresnerf.field.reference.field import ReferenceField
from biresnerf.geometry.camera.camera import Intrinsics, directions_in_cam
from biresnerf.geometry.camera.camera_models import Camera

logger = logging.getLogger(__name__)

LIMIT_S = 600.0  # the first run compiles all kernels
TOLERANCE = 0.02  # products of the networks keep 10 bits of mantissa
JUMPS = (
    1 / 16
)  # of the rays may differ in their gradients: these jump where rounding moves a sample to the next cell
RAYS = 16
_JUMPING = ("gradient by origins", "gradient by directions", "gradient by tables")
_RATES = FieldRates(0.01, 0.005, (0.01, 0.02, 0.01), 0.003)
_GRADIENT = PositionGradient(1.0, 0.5, 0.7)

MakeField = Callable[[FieldShape, int, torch.device], GridField]


@cache
def remembered_faults() -> tuple[str, ...]:
    """What kernels compute otherwise on the present GPU; from the cache, if it was asked before."""
    record, key = _cache_file(), _installation()
    known: dict[str, list[str]] = {}
    try:
        known = json.loads(record.read_text())
    except (OSError, ValueError):
        logger.debug("no record of earlier checks in %s", record)
    if key not in known:
        known[key] = list(_asked())
        try:
            record.parent.mkdir(parents=True, exist_ok=True)
            record.write_text(json.dumps(known, indent=1))
        except OSError as error:
            logger.debug("the check of the GPU is not remembered: %s", error)
    return tuple(known[key])


def _asked() -> tuple[str, ...]:
    logger.info("checking the kernels on this GPU, once")
    command = [sys.executable, "-m", "biresnerf.field.cuda.device_check"]
    try:
        done = subprocess.run(command, capture_output=True, text=True, timeout=LIMIT_S, check=False)
    except subprocess.TimeoutExpired:
        return (f"no answer within {LIMIT_S:.0f} s",)
    if done.returncode != 0:
        return ((done.stderr.strip().splitlines() or [f"exit status {done.returncode}"])[-1],)
    return tuple(json.loads(done.stdout.splitlines()[-1]))


def _installation() -> str:
    """GPU, driver, versions, and the kernels' own text."""
    device = torch.cuda.get_device_properties(torch.cuda.current_device())
    text = b"".join(path.read_bytes() for path in sorted(Path(__file__).parent.glob("*.py")))
    driver = Path("/proc/driver/nvidia/version")
    parts = (
        f"{device.name} {device.major}.{device.minor}",
        driver.read_text().splitlines()[0] if driver.is_file() else "",
        f"torch {version('torch')} {torch.version.cuda}",
        f"triton {version('triton')}",
        hashlib.sha256(text).hexdigest()[:16],
    )
    return ", ".join(parts)


def _cache_file() -> Path:
    base = Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache")
    return base / "biresnerf" / "gpu-checks.json"


def faults(make_fast: MakeField, device: torch.device) -> tuple[str, ...]:
    """What a backend, and the kernel of lenses, compute otherwise than the definition."""
    found = []
    if not _same_directions(device):
        found.append("viewing directions differ")
    for unbounded in (False, True):
        results = [_computed(make, device, unbounded=unbounded) for make in (ReferenceField, make_fast)]
        for name, expected in results[0].items():
            off = _off(results[1][name], expected)
            allowed = JUMPS if name.startswith(_JUMPING) else 0.0
            share = float((~(off <= TOLERANCE)).float().mean()) if len(off) else 0.0
            if share > allowed:
                kind = "open" if unbounded else "bounded"
                found.append(f"{name} ({kind} scene) differs by {float(off.max()):.1%}")
    return tuple(found)


def _same_directions(device: torch.device) -> bool:
    """Of pixels of a distorted and of a fisheye camera."""
    cameras = (
        Camera("OPENCV", 320, 240, (300.0, 310.0, 160.0, 118.0, -0.12, 0.03, 0.002, -0.003)),
        Camera("OPENCV_FISHEYE", 320, 240, (110.0, 108.0, 160.0, 118.0, 0.02, -0.004, 0.001, -0.0002)),
    )
    intrinsics = Intrinsics.from_cameras(cameras).to(device)
    xy = (torch.rand(100, 2, generator=torch.Generator().manual_seed(1)) * torch.tensor([320, 240])).to(
        device
    )
    image = torch.arange(100, device=device) % 2
    apart = (on_device(intrinsics, image, xy) - directions_in_cam(intrinsics, image, xy)).abs().max()
    return bool(apart < 1e-6)


def _off(value: Tensor, expected: Tensor) -> Tensor:
    """How far rows are off, in shares of themselves or of a tenth of the largest; without those near zero."""
    largest = expected.abs().max().clamp(min=1e-8)
    apart, size = ((x.abs().reshape(len(x), -1).amax(1)) for x in (value - expected, expected))
    matters = ~((apart <= TOLERANCE * largest / 10) & (size <= TOLERANCE * largest))
    return (apart / size.clamp(min=float(largest) / 10))[matters]


def _computed(make: MakeField, device: torch.device, *, unbounded: bool) -> dict[str, Tensor]:
    """Everything that a field gives and learns from a batch, in either stage."""
    found: dict[str, Tensor] = {}
    for stage in ("coarse", "fine"):
        draws = torch.Generator().manual_seed(5)
        field = _field(make, device, draws, unbounded=unbounded, reconstructing=stage == "fine")
        occupied = (torch.rand(8, 8, 8, generator=draws) < 0.4).to(torch.uint8).to(device)
        rays, marching = _rays(device, draws, unbounded), Marching(0.1, 0.1, 12.0, 128, occupied)
        for _ in range(2):  # the first time kernels are launched one by one, then recorded and replayed
            field.discard_gradients()
            rays.origin.grad = rays.direction.grad = None
            rendering = field.render(rays, marching, _GRADIENT)
            target = torch.linspace(0, 1, 3 * RAYS, device=device).reshape(-1, 3)
            (((rendering.colour - target) ** 2).mean() + 0.1 * (rendering.opacity**2).mean()).backward()
        values = {
            "colour": rendering.colour,
            "opacity": rendering.opacity,
            "depth": rendering.depth,
            "gradient by origins": rays.origin.grad,
            "gradient by directions": rays.direction.grad,
            **{f"gradient by layer {i}": weight.grad for i, weight in enumerate(field.networks, 1)},
        }
        found |= {f"{name}, {stage}": v.detach().clone() for name, v in values.items() if v is not None}
        field.step(_RATES)
        # Linear in the gradient, which Adam's first step is not.
        found[f"gradient by tables, {stage}"] = torch.cat([m[0].clone() for m in field.moments.values()])
        found[f"density, {stage}"] = _field(
            make, device, draws, unbounded=unbounded, reconstructing=stage == "fine"
        ).density(torch.rand(100, 3, generator=draws).to(device))
    return found


def _field(
    make: MakeField, device: torch.device, draws: torch.Generator, *, unbounded: bool, reconstructing: bool
) -> GridField:
    """A small field with features that matter."""
    field = make(FieldShape(grid_levels(3, 8, 20, 14), grid_levels(3, 16, 60, 10), unbounded), 3, device)
    with torch.no_grad():
        for tensor in (field.pose_table, field.reconstruction_table, field.reconstruction_columns):
            tensor.copy_(torch.rand(tensor.shape, generator=draws) - 0.5)
    if reconstructing:
        field.start_reconstruction()
    return field


def _rays(device: torch.device, draws: torch.Generator, unbounded: bool) -> Rays:
    direction = torch.nn.functional.normalize(torch.randn(RAYS, 3, generator=draws), dim=1)
    origin = (torch.rand(RAYS, 3, generator=draws) - 0.5) * 0.8 - direction * (1.7 if unbounded else 2.6)
    background, jitter = torch.rand(RAYS, 3, generator=draws), torch.rand(RAYS, generator=draws)
    return Rays(
        origin.to(device).requires_grad_(), direction.to(device).requires_grad_(),
        background.to(device), jitter.to(device), RAYS,
    )  # fmt: skip


if __name__ == "__main__":
    from biresnerf.field.cuda.field import CudaField

    print(json.dumps(faults(CudaField, torch.device("cuda"))))  # noqa: T201
