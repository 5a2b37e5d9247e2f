"""Which backend computes the field. Chosen once, at construction, logged and reported; never changed in silence."""

from __future__ import annotations

import logging
import os
from collections.abc import Callable

import torch
from torch import Tensor

from biresnerf.config import Device
from biresnerf.errors import InputError
from biresnerf.field.device_occupancy import DeviceOccupancyGrid
from biresnerf.field.occupancy import OccupancyGrid
from biresnerf.field.radiance_field import FieldShape, RadianceField
from biresnerf.geometry.camera import Intrinsics, directions_in_cam

logger = logging.getLogger(__name__)

Directions = Callable[[Intrinsics, Tensor, Tensor], Tensor]


def choose_device(device: Device) -> torch.device:
    """The torch device asked for; `auto` takes CUDA where there is one. Raises `InputError` for CUDA without one."""
    if device == "cuda" and not torch.cuda.is_available():
        raise InputError(
            "device_unavailable",
            "CUDA was asked for, but torch finds no CUDA device.",
            where="device",
            mend="Use --device auto or cpu, or install torch with CUDA.",
        )
    if device == "auto":
        return torch.device("cuda" if torch.cuda.is_available() else "cpu")
    return torch.device(device)


def use_threads(threads: int) -> int:
    """Give the kernels this many threads (0: every core this process may use), torch one: they must not compete.

    Call before any kernel runs. Returns the number taken.
    """
    import numba

    available = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
    taken = min(threads or available, numba.config.NUMBA_NUM_THREADS)  # type: ignore[attr-defined]
    numba.set_num_threads(taken)
    torch.set_num_threads(1)
    return taken


def make_occupancy(side: int, device: torch.device) -> OccupancyGrid:
    """The occupancy grid; on CUDA the one whose updates never wait for the device."""
    return DeviceOccupancyGrid(side, device) if device.type == "cuda" else OccupancyGrid(side, device)


def directions_for(device: torch.device) -> Directions:
    """`directions_in_cam`, on CUDA the form that never waits for the device."""
    if device.type == "cuda":
        from biresnerf.field.cuda.lens import directions_in_cam as on_device

        return on_device
    return directions_in_cam


def make_field(shape: FieldShape, seed: int, device: torch.device, threads: int) -> RadianceField:
    """The fastest backend for the device: Numba kernels on the CPU, Triton kernels on CUDA.

    Two heads (the wiring `residual`) are in plain torch alone.
    """
    field: RadianceField
    if shape.wiring == "residual":
        from biresnerf.field.reference_field import ReferenceField

        field = ReferenceField(shape, seed, device)
    elif device.type == "cpu":
        from biresnerf.field.cpu_field import CpuField

        field = CpuField(shape, seed, device, threads)
    else:
        from biresnerf.field.cuda_field import CudaField

        field = CudaField(shape, seed, device)
    logger.info("field backend %s on %s, %d threads", field.backend, device, threads)
    return field
