"""BiResNeRF: refine camera poses by optimising poses and a radiance field together.

Importing the package loads neither numpy nor torch: what needs them does when it is first used.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

from biresnerf.errors import BiresnerfError, InputError, Interrupted, RefinementError
from biresnerf.openmp import let_waiting_threads_sleep
from biresnerf.options.refine_options import RefineOptions
from biresnerf.progress import Progress

if TYPE_CHECKING:
    from biresnerf.pipeline import refine_poses
    from biresnerf.result import Result, load

__version__ = "0.1.0"
__all__ = [
    "BiresnerfError",
    "InputError",
    "Interrupted",
    "Progress",
    "RefineOptions",
    "RefinementError",
    "Result",
    "load",
    "refine_poses",
]


def __getattr__(name: str) -> Any:
    if name == "refine_poses":
        let_waiting_threads_sleep()
        from biresnerf.pipeline import refine_poses

        return refine_poses
    if name in ("Result", "load"):
        from biresnerf import result

        return getattr(result, name)
    raise AttributeError(f"module 'biresnerf' has no attribute {name!r}")
