"""LPIPS (Zhang et al. 2018) with VGG, as BAA-NGP reports it; where its package and weights are installed."""

from __future__ import annotations

import importlib
import importlib.util
from collections.abc import Callable
from pathlib import Path

import torch
from torch import Tensor

# What torchvision names the file; the package would download it, which a measurement must not do by itself.
VGG_WEIGHTS = "vgg16-397923af.pth"


def lpips_absent() -> str | None:
    """Why LPIPS cannot be measured here; None where it can."""
    if importlib.util.find_spec("lpips") is None or importlib.util.find_spec("torchvision") is None:
        return "the packages lpips and torchvision are not installed"
    weights = Path(torch.hub.get_dir()) / "checkpoints" / VGG_WEIGHTS
    return None if weights.is_file() else f"the weights {weights} are not there"


def lpips_vgg() -> Callable[[Tensor, Tensor], float]:
    """A function of two images [h, w, 3] in 0..1; call only where `lpips_absent` finds nothing."""
    model = importlib.import_module("lpips").LPIPS(net="vgg", verbose=False).eval()

    @torch.no_grad()
    def distance(image: Tensor, reference: Tensor) -> float:
        a, b = (2 * x.permute(2, 0, 1)[None].float() - 1 for x in (image, reference))
        return float(model(a, b))

    return distance
