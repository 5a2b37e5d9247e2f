"""The machine that measurements were made on, in words."""

from __future__ import annotations

import platform

from biresnerf import __version__
from biresnerf.machine import usable_cores


def describe_machine() -> str:
    """Cores, architecture and versions, in one line."""
    return f"{usable_cores()} cores ({platform.machine()}), Python {platform.python_version()}, BiResNeRF {__version__}"
