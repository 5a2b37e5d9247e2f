"""Checkpoints: all state of a run in one safetensors file, written whole or not at all."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import torch
from safetensors import SafetensorError, safe_open
from safetensors.torch import save_file
from torch import Tensor

from biresnerf.data.model.atomic_file import whole_file
from biresnerf.data.points.feature_matches import KEPT
from biresnerf.errors import InputError

CHECKPOINT = Path("checkpoint") / "latest.safetensors"
SEEDING = CHECKPOINT.with_name("seeding.json")  # what COLMAP answered; every checkpoint carries a copy
MATCHES = CHECKPOINT.with_name(KEPT)  # feature matches; every checkpoint carries them, too
COARSE = CHECKPOINT.with_name("coarse.safetensors")  # the state as stage 1 ended, for runs that share it
FORMAT = "3"


def save_checkpoint(
    folder: Path, tensors: dict[str, Tensor], notes: dict[str, Any], name: Path = CHECKPOINT
) -> Path:
    """Write `folder`/checkpoint/latest.safetensors; `notes` is JSON data kept beside the tensors."""
    path = folder / name
    path.parent.mkdir(parents=True, exist_ok=True)
    contiguous = {name: tensor.detach().cpu().contiguous() for name, tensor in tensors.items()}
    with whole_file(path) as temporary:
        save_file(contiguous, temporary, metadata={"format": FORMAT, "notes": json.dumps(notes)})
    return path


def load_checkpoint(folder: Path, name: Path = CHECKPOINT) -> tuple[dict[str, Tensor], dict[str, Any]] | None:
    """Tensors and notes of the checkpoint in `folder`, None where there is none.

    Raises:
        InputError: ``checkpoint_invalid`` if the file is damaged or of another version.
    """
    path = folder / name
    if not path.is_file():
        return None
    try:
        with safe_open(path, framework="pt") as file:
            metadata = file.metadata() or {}
            tensors: dict[str, torch.Tensor] = {name: file.get_tensor(name) for name in file.keys()}  # noqa: SIM118
    except (SafetensorError, OSError) as error:
        raise _invalid(path, f"cannot be read ({error}).") from error
    if metadata.get("format") != FORMAT:
        raise _invalid(path, "was written by another version.")
    return tensors, json.loads(metadata["notes"])


def _invalid(path: Path, what: str) -> InputError:
    return InputError(
        "checkpoint_invalid", what, where=str(path), hint="Choose another output folder, or remove this one."
    )
