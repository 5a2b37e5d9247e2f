"""BiResNeRF: refine camera poses by optimising poses and a radiance field together.

Importing the package loads neither torch nor numba; ``refine_poses`` does when it is first used.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

from biresnerf.errors import BiresnerfError, InputError, Interrupted, RefinementError
from biresnerf.openmp import let_waiting_threads_sleep
from biresnerf.options.refine_options import RefineOptions
from biresnerf.progress import Progress

if TYPE_CHECKING:
    from biresnerf.pipeline import refine_poses

__version__ = "0.1.0"
__all__ = [
    "BiresnerfError",
    "InputError",
    "Interrupted",
    "Progress",
    "RefineOptions",
    "RefinementError",
    "refine_poses",
]


def __getattr__(name: str) -> Any:
    if name == "refine_poses":
        let_waiting_threads_sleep()
        from biresnerf.pipeline import refine_poses

        return refine_poses
    raise AttributeError(f"module 'biresnerf' has no attribute {name!r}")
