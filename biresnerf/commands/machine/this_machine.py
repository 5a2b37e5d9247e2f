"""The machine that measurements were made on, in words."""

from __future__ import annotations

import os
import platform

from biresnerf import __version__


def describe_machine() -> str:
    """Cores, architecture and versions, in one line."""
    cores = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count()
    return (
        f"{cores} cores ({platform.machine()}), Python {platform.python_version()}, BiResNeRF {__version__}"
    )
