"""BiResNeRF: refine camera poses by optimising poses and a radiance field together.

Importing the package loads neither numpy nor torch: what needs them does when it is first used.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

from biresnerf.errors import BiresnerfError, InputError, Interrupted, RefinementError
from biresnerf.options.refine_options import RefineOptions
from biresnerf.progress import Progress

if TYPE_CHECKING:
    from biresnerf.result import Result, load
    from biresnerf.run.refine import refine

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
    "refine",
]
_MODULES = {"refine": "run.refine", "load": "result", "Result": "result"}


def __getattr__(name: str) -> Any:
    if name not in _MODULES:
        raise AttributeError(f"module 'biresnerf' has no attribute {name!r}")
    from importlib import import_module

    return getattr(import_module(f"biresnerf.{_MODULES[name]}"), name)


def __dir__() -> list[str]:
    return sorted([*__all__, "__version__"])
