"""The CUDA backend's kernels, loaded once: compiled where there is a GPU, else run by Triton's interpreter."""

from __future__ import annotations

import contextlib
import importlib
import importlib.util
import os

import torch

# Triton decides when its functions are defined, so this comes before anything imports it. The variable is gone again
# right after: no other test and no process that a test starts sees it.
if importlib.util.find_spec("triton") is not None and not torch.cuda.is_available():
    os.environ["TRITON_INTERPRET"] = "1"
    try:
        for module in ("field", "cameras.lens", "cameras.kernels"):
            importlib.import_module(f"biresnerf.field.cuda.{module}")
        with contextlib.suppress(ImportError):  # not in every version; else loaded at the first launch
            importlib.import_module("triton.experimental.gluon")
    finally:
        del os.environ["TRITON_INTERPRET"]
