"""Checkpoints: whole or not at all, and refused when they are damaged."""

from __future__ import annotations

import subprocess
import sys

import pytest
import torch

from biresnerf.errors import InputError
from biresnerf.refine.stages.checkpoint import CHECKPOINT, load_checkpoint, save_checkpoint
from tests.data.scenes import assert_complete

NOTES = {"step": 3, "seconds": {"coarse": 0.1 + 0.2}, "nothing": None, "text": "ä\n"}


def tensors() -> dict[str, torch.Tensor]:
    return {
        "wide": torch.arange(12.0).reshape(3, 4)[:, 1:3],  # not contiguous
        "bytes": torch.arange(256, dtype=torch.uint8),
        "counter": torch.tensor(7),
        "parameter": torch.ones(2, dtype=torch.float64, requires_grad=True),
        "empty": torch.zeros(0, 3),
    }


def test_tensors_and_notes_come_back_as_they_were(tmp_path):
    assert save_checkpoint(tmp_path / "new folder", tensors(), NOTES) == tmp_path / "new folder" / CHECKPOINT
    loaded, notes = load_checkpoint(tmp_path / "new folder")
    assert notes == NOTES
    assert loaded.keys() == tensors().keys()
    for name, tensor in tensors().items():
        assert loaded[name].dtype == tensor.dtype
        assert torch.equal(loaded[name], tensor)


def test_a_folder_without_one_gives_none(tmp_path):
    assert load_checkpoint(tmp_path) is None
    assert load_checkpoint(tmp_path / "missing") is None


@pytest.mark.parametrize("keep", [0.0, 0.001, 0.5, 0.99])
def test_a_truncated_file_is_refused_with_its_name_and_the_mend(tmp_path, keep):
    path = save_checkpoint(tmp_path, {"table": torch.rand(5000)}, NOTES)
    content = path.read_bytes()
    path.write_bytes(content[: int(keep * len(content))])
    with pytest.raises(InputError) as caught:
        load_checkpoint(tmp_path)
    assert_complete(caught.value, "checkpoint_invalid", str(path))


def test_a_file_of_another_version_is_refused(tmp_path):
    from safetensors.torch import save_file

    (tmp_path / CHECKPOINT).parent.mkdir()
    save_file({"table": torch.rand(5)}, tmp_path / CHECKPOINT, metadata={"format": "0", "notes": "{}"})
    with pytest.raises(InputError) as caught:
        load_checkpoint(tmp_path)
    assert_complete(caught.value, "checkpoint_invalid")


def test_a_kill_in_the_middle_of_writing_leaves_the_old_checkpoint(tmp_path):
    save_checkpoint(tmp_path, {"table": torch.zeros(5)}, {"step": 1})
    killed = subprocess.run(
        [
            sys.executable,
            "-c",
            f"""
import os, signal, torch
import biresnerf.refine.stages.checkpoint as checkpoint
def half(tensors, path, metadata):
    path.write_bytes(b"x" * 1000)
    os.kill(os.getpid(), signal.SIGKILL)
checkpoint.save_file = half
from pathlib import Path
checkpoint.save_checkpoint(Path({str(tmp_path)!r}), {{"table": torch.ones(5)}}, {{"step": 2}})
""",
        ],
        check=False,
    )
    assert killed.returncode == -9
    loaded, notes = load_checkpoint(tmp_path)
    assert notes == {"step": 1}
    assert torch.equal(loaded["table"], torch.zeros(5))
