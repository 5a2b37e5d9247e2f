"""The CUDA backend's kernels, loaded once: compiled where there is a GPU, else run by Triton's interpreter."""

from __future__ import annotations

import contextlib
import importlib
import importlib.util
import inspect
import os
from typing import Any

import torch


def _patch_once(interpreter: Any) -> None:
    """Triton looks all its functions over again at each call of a function by a kernel: a third of the time."""
    patch, run = interpreter._patch_lang, interpreter.GridExecutor.__call__
    patched: set[frozenset[str]] = set()

    def within(*arguments: Any, **named: Any) -> Any:
        patched.clear()  # what the kernel before this one had patched was taken back
        return run(*arguments, **named)

    def patch_new(function: Any) -> Any:
        modules = filter(inspect.ismodule, function.__globals__.values())
        names = frozenset(m.__name__ for m in modules if m in (interpreter.tl, interpreter.tl.core))
        if names in patched:
            return None
        patched.add(names)
        return patch(function)

    interpreter.GridExecutor.__call__ = within
    interpreter._patch_lang = patch_new


# Triton decides when its functions are defined, so this comes before anything imports it. The variable is gone again
# right after: no other test and no process that a test starts sees it.
if importlib.util.find_spec("triton") is not None and not torch.cuda.is_available():
    os.environ["TRITON_INTERPRET"] = "1"
    try:
        for module in ("field", "cameras.lens", "cameras.kernels"):
            importlib.import_module(f"biresnerf.field.cuda.{module}")
        with contextlib.suppress(ImportError):  # not in every version; else loaded at the first launch
            importlib.import_module("triton.experimental.gluon")
        with contextlib.suppress(ImportError, AttributeError):  # nor are its inner names
            _patch_once(importlib.import_module("triton.runtime.interpreter"))
    finally:
        del os.environ["TRITON_INTERPRET"]
