"""Which backend computes the field. Chosen once, at construction, logged and reported; never changed in silence."""

from __future__ import annotations

import logging
import os

import torch

from biresnerf.config import Device
from biresnerf.errors import InputError
from biresnerf.field.radiance_field import FieldShape, RadianceField

logger = logging.getLogger(__name__)


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


def make_field(shape: FieldShape, seed: int, device: torch.device, threads: int) -> RadianceField:
    """The fastest backend for the device: Numba kernels on the CPU, plain torch elsewhere."""
    field: RadianceField
    if device.type == "cpu":
        from biresnerf.field.cpu_field import CpuField

        field = CpuField(shape, seed, device, threads)
    else:
        from biresnerf.field.reference_field import ReferenceField

        field = ReferenceField(shape, seed, device)
    logger.info("field backend %s on %s, %d threads", field.backend, device, threads)
    return field
