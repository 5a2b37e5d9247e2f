"""Which backend computes the field. Chosen once, at construction, logged and reported; never changed in silence."""

from __future__ import annotations

import importlib.util
import logging
from collections.abc import Callable
from types import ModuleType

import torch
from torch import Tensor

from biresnerf.errors import InputError
from biresnerf.field.occupancy import DeviceOccupancyGrid, OccupancyGrid
from biresnerf.field.radiance_field import FieldShape, RadianceField
from biresnerf.geometry.camera.camera import Intrinsics, directions_in_cam
from biresnerf.machine import usable_cores
from biresnerf.options.refine_options import Device, RefineOptions, ResolvedOptions

logger = logging.getLogger(__name__)

LEAST_CAPABILITY = (8, 0)  # TF32, and shared memory enough for the networks' backward pass

Directions = Callable[[Intrinsics, Tensor, Tensor], Tensor]


def choose_device(device: Device) -> torch.device:
    """The requested torch device. `auto` selects CUDA if it is usable and logs the reason if it is not.

    Raises `InputError` for CUDA that cannot be used.
    """
    if device == "cpu":
        return torch.device("cpu")
    problem = cuda_problem()
    if problem is None:
        return torch.device("cuda")
    if device == "cuda":
        raise InputError(
            "device_unavailable",
            f"CUDA was asked for, but {problem}.",
            where="device",
            hint="Use --device auto or cpu, or install torch with CUDA and, where it does not bring it, Triton.",
        )
    if torch.cuda.is_available():
        logger.warning("computing on the CPU: %s", problem)
    return torch.device("cpu")


def resolve_here(options: RefineOptions) -> tuple[ResolvedOptions, torch.device]:
    """The options resolved for the device that they request, and that device.

    Raises `InputError` if CUDA is requested and cannot be used, and for options that contradict each other.
    """
    device = choose_device(options.device)
    return options.resolved("cuda" if device.type == "cuda" else "cpu"), device


def cuda_problem() -> str | None:
    """Why the CUDA backend cannot run here."""
    if not torch.cuda.is_available():
        return "torch finds no CUDA device"
    if importlib.util.find_spec("triton") is None:
        return "Triton, which its kernels are written in, is not installed"
    capability = torch.cuda.get_device_capability()
    if capability < LEAST_CAPABILITY:
        return f"the GPU's compute capability is {capability[0]}.{capability[1]}, and the kernels need 8.0"
    return None


def use_threads(threads: int) -> int:
    """Give the kernels this many threads (0: every core this process may use), torch one: they must not compete.

    Call before any kernel runs. Returns the number taken.
    """
    import numba

    taken = min(threads or usable_cores(), numba.config.NUMBA_NUM_THREADS)  # type: ignore[attr-defined]
    numba.set_num_threads(taken)
    torch.set_num_threads(1)
    return taken


def make_occupancy(side: int, device: torch.device) -> OccupancyGrid:
    """The occupancy grid; on CUDA the one whose updates never wait for the device."""
    return DeviceOccupancyGrid(side, device) if device.type == "cuda" else OccupancyGrid(side, device)


def gpu_faults(device: torch.device) -> tuple[str, ...]:
    """Differences between the kernels' results on this GPU and the plain-torch definition; empty on a CPU."""
    if device.type != "cuda":
        return ()
    from biresnerf.field.cuda.device_check import remembered_faults

    return remembered_faults()


def directions_for(device: torch.device) -> Directions:
    """The kernel that computes `directions_in_cam` on the device; the definition on a GPU whose kernels are wrong."""
    if device.type == "cpu":
        from biresnerf.field.cpu.lens import directions_in_cam as by_kernel
    elif device.type == "cuda" and not gpu_faults(device):
        from biresnerf.field.cuda.cameras.lens import directions_in_cam as by_kernel
    else:
        return directions_in_cam
    return by_kernel


def camera_kernels(device: torch.device) -> ModuleType | None:
    """The kernels of poses and rays on a GPU, see `cuda.cameras.poses_and_rays`; None elsewhere, or where wrong."""
    if device.type != "cuda" or gpu_faults(device):
        return None
    from biresnerf.field.cuda.cameras import poses_and_rays

    return poses_and_rays


def make_field(
    shape: FieldShape, options: ResolvedOptions, device: torch.device, threads: int
) -> RadianceField:
    """The fastest backend for the device: Numba kernels on the CPU, Triton kernels on CUDA.

    Plain torch where the options ask for it, and in place of kernels that did not pass their check on this GPU.
    """
    field: RadianceField
    faults = gpu_faults(device)
    if options.field == "reference" or faults:
        from biresnerf.field.reference.field import ReferenceField

        if faults:
            logger.warning(
                "using plain torch: the CUDA kernels did not pass their check on this GPU (%s)", faults[0]
            )
        field = ReferenceField(shape, options.seed, device)
    elif device.type == "cpu":
        from biresnerf.field.cpu.field import CpuField

        field = CpuField(shape, options.seed, device, threads)
    else:
        from biresnerf.field.cuda.field import CudaField

        field = CudaField(shape, options.seed, device)
    logger.info("field backend %s on %s, %d threads", field.backend, device, threads)
    return field
