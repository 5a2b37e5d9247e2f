"""How OpenMP's threads wait; to be set before torch is loaded, whose OpenMP the kernels share."""

from __future__ import annotations

import os


def let_waiting_threads_sleep() -> None:
    """Let waiting threads yield their cores, unless the user has set how they wait.

    By default, libgomp lets them spin first. A run gains nothing from that, and concurrent jobs compete for cores.
    """
    os.environ.setdefault("OMP_WAIT_POLICY", "passive")
