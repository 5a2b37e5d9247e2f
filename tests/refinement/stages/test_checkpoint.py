"""Checkpoints: whole or not at all, and refused when they are damaged."""

from __future__ import annotations

import json
import subprocess
import sys

import numpy as np
import pytest
import torch
from safetensors.torch import save_file

from biresnerf.data.points.tracks import Tracks
from biresnerf.data.seeding.initial_poses import InitialPoses
from biresnerf.errors import InputError
from biresnerf.refinement.lost.lost_cameras import RepairState
from biresnerf.refinement.optimise.optimiser_state import StepState
from biresnerf.refinement.stages.checkpoint import (
    COARSE,
    FORMAT,
    Checkpoint,
    RunOrigin,
    RunRecord,
    load_checkpoint,
    save_checkpoint,
    track_tensors,
)
from biresnerf.refinement.stages.stability import DetectorState
from biresnerf.report import TrialReport
from biresnerf.stages import CHECKPOINT
from tests.data.scenes import assert_complete

POSES = np.random.default_rng(0).normal(0, 1e3, (3, 4, 4)) / 3


def checkpoint(tensors: dict[str, torch.Tensor], step: int = 3) -> Checkpoint:
    return Checkpoint(
        origin=RunOrigin(fingerprint="a", stage_1_fingerprint="b", seeding="ä\n"),
        start=InitialPoses(
            POSES,
            "given",
            ("given", "given", "neighbours"),
            (TrialReport(source="given", placed=0, psnr=0.1),),
        ),
        record=RunRecord(seconds={"coarse": 0.1 + 0.2}),
        optimiser=StepState(
            step_index=step, switch=None, rays=7, poses_held=True, planned_steps=40, steps=40
        ),
        detector=DetectorState(decibels=(1 / 3, float("inf")), confirmed=1),
        repair=RepairState(repaired=(1, 2), times=1, spent=1e9 / 7),
        block_errors=(2 / 3, float("nan")),
        tensors=tensors,
    )


def tensors() -> dict[str, torch.Tensor]:
    return {
        "wide": torch.arange(12.0).reshape(3, 4)[:, 1:3],  # not contiguous
        "bytes": torch.arange(256, dtype=torch.uint8),
        "counter": torch.tensor(7),
        "parameter": torch.ones(2, dtype=torch.float64, requires_grad=True),
        "empty": torch.zeros(0, 3),
    }


def test_tensors_and_notes_come_back_as_they_were(tmp_path):
    saved = checkpoint(tensors())
    assert save_checkpoint(tmp_path / "new folder", saved) == tmp_path / "new folder" / CHECKPOINT
    loaded = load_checkpoint(tmp_path / "new folder")
    for part in ("ends_stage_1", "origin", "record", "optimiser", "detector", "repair"):
        assert getattr(loaded, part) == getattr(saved, part), part
    np.testing.assert_array_equal(loaded.block_errors, saved.block_errors)
    np.testing.assert_array_equal(loaded.start.world_from_cam, POSES)
    assert (loaded.start.sources, loaded.start.trials) == (saved.start.sources, saved.start.trials)
    assert loaded.tensors.keys() == tensors().keys()
    for name, tensor in tensors().items():
        assert loaded.tensors[name].dtype == tensor.dtype
        assert torch.equal(loaded.tensors[name], tensor)


def test_the_end_of_stage_1_has_a_file_of_its_own(tmp_path):
    ending = checkpoint({"table": torch.zeros(5)}).model_copy(update={"ends_stage_1": True})
    assert save_checkpoint(tmp_path, ending) == tmp_path / COARSE
    assert load_checkpoint(tmp_path) is None
    assert load_checkpoint(tmp_path, COARSE).ends_stage_1


def test_tracks_come_back_as_a_run_has_them(tmp_path):
    images, xy = np.array([[0, 1], [1, 2]]), np.random.default_rng(0).uniform(0, 640, (2, 2, 2))
    tracks = Tracks.of_matches(images, xy)
    save_checkpoint(tmp_path, checkpoint(track_tensors(tracks)))
    back = load_checkpoint(tmp_path).tracks
    for name in ("point", "image", "xy"):
        np.testing.assert_array_equal(getattr(back, name), getattr(tracks, name))
    save_checkpoint(tmp_path, checkpoint(track_tensors(None)))
    assert load_checkpoint(tmp_path).tracks is None


def test_a_folder_without_one_gives_none(tmp_path):
    assert load_checkpoint(tmp_path) is None
    assert load_checkpoint(tmp_path / "missing") is None


@pytest.mark.parametrize("keep", [0.0, 0.001, 0.5, 0.99])
def test_a_truncated_file_is_refused_with_its_name_and_the_hint(tmp_path, keep):
    path = save_checkpoint(tmp_path, checkpoint({"table": torch.rand(5000)}))
    content = path.read_bytes()
    path.write_bytes(content[: int(keep * len(content))])
    with pytest.raises(InputError) as caught:
        load_checkpoint(tmp_path)
    assert_complete(caught.value, "checkpoint_invalid", str(path))


@pytest.mark.parametrize(
    "metadata", [{"format": "0", "state": "{}"}, {"format": FORMAT, "state": json.dumps({"unknown": 1})}]
)
def test_a_file_of_another_version_is_refused(tmp_path, metadata):
    (tmp_path / CHECKPOINT).parent.mkdir()
    save_file({"table": torch.rand(5)}, tmp_path / CHECKPOINT, metadata=metadata)
    with pytest.raises(InputError) as caught:
        load_checkpoint(tmp_path)
    assert_complete(caught.value, "checkpoint_invalid")


@pytest.mark.slow
def test_a_kill_in_the_middle_of_writing_leaves_the_old_checkpoint(tmp_path):
    save_checkpoint(tmp_path, checkpoint({"table": torch.zeros(5)}, step=1))
    killed = subprocess.run(
        [
            sys.executable,
            "-c",
            f"""
import os, signal, torch
import biresnerf.refinement.stages.checkpoint as checkpoint
def half(tensors, path, metadata):
    path.write_bytes(b"x" * 1000)
    os.kill(os.getpid(), signal.SIGKILL)
checkpoint.save_file = half
from pathlib import Path
from tests.refinement.stages import test_checkpoint
checkpoint.save_checkpoint(Path({str(tmp_path)!r}), test_checkpoint.checkpoint({{"table": torch.ones(5)}}, step=2))
""",
        ],
        check=False,
    )
    assert killed.returncode == -9
    loaded = load_checkpoint(tmp_path)
    assert loaded.optimiser.step_index == 1
    assert torch.equal(loaded.tensors["table"], torch.zeros(5))
