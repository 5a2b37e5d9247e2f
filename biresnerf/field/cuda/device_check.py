"""Compares the kernels on this GPU with the plain-torch definition, on a small batch.

``python -m biresnerf.field.cuda.device_check`` prints the differences as a JSON list. `remembered_faults` runs it once
for each GPU, driver and version, in its own process, because a kernel that faults ends its process.
"""

from __future__ import annotations

import hashlib
import json
import logging
import subprocess
import sys
from functools import cache
from importlib.metadata import version
from pathlib import Path

import torch
from torch import Tensor

from biresnerf.field.cuda.cameras import poses_and_rays
from biresnerf.field.cuda.cameras.lens import directions_in_cam as on_device
from biresnerf.field.cuda.check_batch import (
    DefinedField,
    MakeField,
    defined_poses,
    defined_rays,
    learn,
    moved_and_cast,
    random_field,
    random_marching,
    random_rays,
)
from biresnerf.field.grid_levels import grid_levels
from biresnerf.field.radiance_field import FieldRates, FieldShape, Merging, PositionGradient
from biresnerf.forecast.rates import cache_folder
from biresnerf.geometry.camera.camera import Intrinsics, directions_in_cam
from biresnerf.geometry.camera.camera_models import Camera

logger = logging.getLogger(__name__)

LIMIT_S = 600.0  # the first run compiles all kernels
CAMERA_TOLERANCE = 1e-3  # of poses, rays and their gradients: both compute them in float32 at least
TOLERANCE = 0.02  # sums come in another order, which moves a few samples over a unit's kink
# Of the rays, how many may have other gradients: these jump where rounding moves a sample to the next cell. The same
# holds for what is rendered of merged intervals, where rounding ends a run of them elsewhere.
JUMPING_SHARE = 1 / 16
RAYS = 16
_MERGED = "colour of merged intervals"
_JUMPING = ("gradient by origins", "gradient by directions", "gradient by tables", _MERGED)
_RATES = FieldRates(0.01, 0.005, (0.01, 0.02, 0.01), 0.003)
_GRADIENT = PositionGradient(1.0, 0.5, 0.7)


@cache
def remembered_faults() -> tuple[str, ...]:
    """What the check finds on this GPU; from the cache where an earlier one ran to its end."""
    record, key = _cache_file(), _installation()
    known = _read(record)
    if key in known:
        return tuple(known[key])
    logger.info("checking the kernels on this GPU, once")
    found = _check_in_own_process()
    if isinstance(found, str):  # a busy GPU may be free the next time
        return (found,)
    try:
        record.parent.mkdir(parents=True, exist_ok=True)
        record.write_text(json.dumps(known | {key: found}, indent=1))
    except OSError as error:
        logger.debug("could not write %s: %s", record, error)
    return tuple(found)


def _read(record: Path) -> dict[str, list[str]]:
    try:
        known = json.loads(record.read_text())
    except (OSError, ValueError) as error:
        logger.debug("could not read %s: %s", record, error)
        return {}
    return known if isinstance(known, dict) else {}


def _check_in_own_process() -> list[str] | str:
    """What it finds; or, where the check did not run to its end, why."""
    command = [sys.executable, "-m", __name__]
    try:
        done = subprocess.run(command, capture_output=True, text=True, timeout=LIMIT_S, check=False)
    except subprocess.TimeoutExpired:
        return f"the check did not end within {LIMIT_S:.0f} s"
    if done.returncode == 0:
        return list(json.loads(done.stdout.splitlines()[-1]))
    last_words = done.stderr.strip().splitlines() or [f"exit status {done.returncode}"]
    return f"the check failed: {last_words[-1]}"


def _installation() -> str:
    """GPU, driver, versions, and the text of the kernels."""
    device = torch.cuda.get_device_properties(torch.cuda.current_device())
    text = b"".join(path.read_bytes() for path in sorted(Path(__file__).parent.rglob("*.py")))
    driver = Path("/proc/driver/nvidia/version")
    parts = (
        f"{device.name} {device.major}.{device.minor}",
        driver.read_text().splitlines()[0] if driver.is_file() else "",
        f"torch {version('torch')} {torch.version.cuda}",
        f"triton {version('triton')}",
        f"kernels {hashlib.sha256(text).hexdigest()[:16]}",
    )
    return ", ".join(parts)


def _cache_file() -> Path:
    return cache_folder() / "gpu-checks.json"


def faults(make_fast: MakeField, device: torch.device) -> tuple[str, ...]:
    """How the results of a backend, and of the cameras' kernels, differ from the definition."""
    found = []
    if not _same_directions(device):
        found.append("viewing directions differ")
    found += _differing_cameras(device)
    for unbounded in (False, True):
        results = [_computed(make, device, unbounded=unbounded) for make in (DefinedField, make_fast)]
        for name, expected in results[0].items():
            off = _off(results[1][name], expected)
            allowed = JUMPING_SHARE if name.startswith(_JUMPING) else 0.0
            share = float((~(off <= TOLERANCE)).float().mean()) if len(off) else 0.0
            if share > allowed:
                kind = "open" if unbounded else "bounded"
                found.append(f"{name} ({kind} scene) differs by {float(off.max()):.1%}")
    return tuple(found)


def _same_directions(device: torch.device) -> bool:
    """Whether the lens kernel agrees on pixels of a distorted and of a fisheye camera."""
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


def _differing_cameras(device: torch.device) -> list[str]:
    """What differs of poses, rays and their gradients, for turns from none to more than a radian."""
    found = []
    for angle in (0.0, 0.3, 2.0):
        kernels = moved_and_cast(poses_and_rays.moved_poses, poses_and_rays.rays_of_cameras, angle, device)
        for name, expected in moved_and_cast(defined_poses, defined_rays, angle, device).items():
            apart = float((kernels[name] - expected).abs().max() / expected.abs().max())
            if not apart <= CAMERA_TOLERANCE:
                found.append(f"{name} of cameras that turned by {angle:.1f} rad: differ by {apart:.1%}")
    return found


def _off(value: Tensor, expected: Tensor) -> Tensor:
    """Relative differences of rows (of at least a tenth of the largest row); rows near zero are left out."""
    largest = expected.abs().max().clamp(min=1e-8)
    apart, size = ((x.abs().reshape(len(x), -1).amax(1)) for x in (value - expected, expected))
    matters = ~((apart <= TOLERANCE * largest / 10) & (size <= TOLERANCE * largest))
    return (apart / size.clamp(min=float(largest) / 10))[matters]


def _computed(make: MakeField, device: torch.device, *, unbounded: bool) -> dict[str, Tensor]:
    """Everything that a field renders and learns from a batch, in both stages."""
    found: dict[str, Tensor] = {}
    shape = FieldShape(grid_levels(3, 8, 20, 14), grid_levels(3, 16, 60, 10), unbounded)
    rays = random_rays(RAYS, RAYS, device, unbounded=unbounded)
    marching, merging = random_marching(device), random_marching(device, step=0.05, merging=Merging(0.05, 4))
    probes = torch.rand(100, 3, generator=torch.Generator().manual_seed(9)).to(device)
    for stage in ("coarse", "fine"):
        field = random_field(make, shape, device, reconstructing=stage == "fine")
        found[f"density, {stage}"] = field.density(probes)
        with torch.no_grad():
            found[f"{_MERGED}, {stage}"] = field.render(rays, merging, _GRADIENT).colour
        for _ in range(2):  # the first time kernels are launched one by one, then recorded and replayed
            field.discard_gradients()
            rays.origin.grad = rays.direction.grad = None
            rendering = learn(field, rays, marching, _GRADIENT)
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
    return found


if __name__ == "__main__":
    from biresnerf.field.cuda.field import CudaField

    # On the CPU, Triton's interpreter runs the kernels (TRITON_INTERPRET=1).
    print(json.dumps(faults(CudaField, torch.device(*sys.argv[1:] or ["cuda"]))))  # noqa: T201
