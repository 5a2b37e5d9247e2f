"""How OpenMP's threads behave; to be said before torch is loaded, whose OpenMP the kernels share."""

from __future__ import annotations

import os


def let_waiting_threads_sleep() -> None:
    """Threads that wait leave their cores to others, unless the user has said how they wait.

    By itself libgomp has them spin first. A run gains nothing by it, and jobs side by side take each other's cores.
    """
    os.environ.setdefault("OMP_WAIT_POLICY", "passive")
