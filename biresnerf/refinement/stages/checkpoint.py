"""Checkpoints: all state of a run in one safetensors file, written whole or not at all.

The tensors are the file's tensors; all else is the JSON of `Checkpoint` in its metadata.
"""

from __future__ import annotations

import json
from dataclasses import dataclass
from pathlib import Path

import torch
from pydantic import Field, ValidationError
from safetensors import SafetensorError, safe_open
from safetensors.torch import save_file
from torch import Tensor

from biresnerf.data.model.atomic_file import whole_file
from biresnerf.data.points.tracks import KEPT, Tracks
from biresnerf.data.seeding.initial_poses import InitialPoses, PoseArray
from biresnerf.errors import InputError
from biresnerf.frozen_model import FrozenModel
from biresnerf.refinement.lost.lost_cameras import RepairState
from biresnerf.refinement.optimise.optimiser_state import StepState
from biresnerf.refinement.stages.stability import DetectorState
from biresnerf.report import CandidateReport, SwitchReason, Verdict
from biresnerf.stages import CHECKPOINT, OTHER_FOLDER

SEEDING = CHECKPOINT.with_name("seeding.json")  # COLMAP's result; every checkpoint carries a copy
TRACKS = CHECKPOINT.with_name(KEPT)  # through feature matches; every checkpoint carries them, too
COARSE = CHECKPOINT.with_name("coarse.safetensors")  # the state at the end of stage 1, for runs that share it
FORMAT = "9"
TRACKED = "tracks."  # before the names of tensors


class RunOrigin(FrozenModel, arbitrary_types_allowed=True):
    """What a run was started with: only a run of the same origin continues it.

    Attributes:
        fingerprint: of photos, given poses and options.
        stage_1_fingerprint: the same without the options that do not affect stage 1.
        seeding: COLMAP's result, if it ran: it would differ slightly in another run.
    """

    fingerprint: str = ""
    stage_1_fingerprint: str = ""
    seeding: str | None = None


@dataclass(frozen=True, eq=False)
class BestSoFar:
    """Poses and lenses of one moment, and what was found of them. `verdict.so_far` chooses them.

    Attributes:
        unit_from_cam: float64 [n, 4, 4], in the optimisation's frame.
        increments: of the lenses, float64 [cameras, columns].
        verdict: on these poses.
        gain: the most that any poses were found to gain on the input's, log2 of the matches' error.
    """

    unit_from_cam: PoseArray
    increments: PoseArray
    verdict: Verdict
    gain: float


class RunRecord(FrozenModel, arbitrary_types_allowed=True):
    """What has happened in a run so far.

    Attributes:
        resumed: how often.
        switch_reason: why stage 2 began.
        adjusted: whether all cameras were adjusted on the way through stage 2.
        candidates: the poses that were compared then.
        believed: whether that evidence is believed.
        adjusts_again: whether they are adjusted after the last step, too, as nothing was better than their poses.
        best: the poses to offer before the end; None while none were better than the input's.
        seconds: spent in each part of the run.
    """

    resumed: int = 0
    switch_reason: SwitchReason | None = None
    adjusted: bool = False
    candidates: tuple[CandidateReport, ...] = ()
    believed: bool = False
    adjusts_again: bool = True
    best: BestSoFar | None = None
    seconds: dict[str, float] = Field(default_factory=lambda: {"coarse": 0.0, "fine": 0.0})


class Checkpoint(FrozenModel, arbitrary_types_allowed=True):
    """All that a run needs to continue, in this process or another.

    Attributes:
        ends_stage_1: whether this is the state at the end of stage 1, kept for other runs.
        block_errors: mean squared errors of the steps since the detector's last check.
        tensors: of the optimisation and the tracks, on the CPU.
    """

    ends_stage_1: bool = False
    origin: RunOrigin
    start: InitialPoses
    record: RunRecord
    optimiser: StepState
    detector: DetectorState
    repair: RepairState
    block_errors: tuple[float, ...] = ()
    tensors: dict[str, Tensor] = Field(exclude=True, repr=False)

    @property
    def tracks(self) -> Tracks | None:
        """The tracks that it carries."""
        arrays = {
            k.removeprefix(TRACKED): v.numpy() for k, v in self.tensors.items() if k.startswith(TRACKED)
        }
        return Tracks.of(**arrays) if arrays else None


def track_tensors(tracks: Tracks | None) -> dict[str, Tensor]:
    """Tracks as tensors of a checkpoint."""
    if tracks is None:
        return {}
    return {TRACKED + name: torch.from_numpy(array) for name, array in tracks.kept().items()}


def save_checkpoint(folder: Path, checkpoint: Checkpoint) -> Path:
    """Write `folder`/checkpoint/latest.safetensors, or coarse.safetensors at the end of stage 1."""
    path = folder / (COARSE if checkpoint.ends_stage_1 else CHECKPOINT)
    path.parent.mkdir(parents=True, exist_ok=True)
    contiguous = {name: tensor.detach().cpu().contiguous() for name, tensor in checkpoint.tensors.items()}
    state = json.dumps(checkpoint.model_dump())
    with whole_file(path) as temporary:
        save_file(contiguous, temporary, metadata={"format": FORMAT, "state": state})
    return path


def load_checkpoint(folder: Path, name: Path = CHECKPOINT) -> Checkpoint | None:
    """The checkpoint in `folder`, None where there is none.

    Raises:
        InputError: ``checkpoint_invalid`` if the file is damaged or of another version.
    """
    path = folder / name
    if not path.is_file():
        return None
    try:
        with safe_open(path, framework="pt") as file:
            metadata = file.metadata() or {}
            tensors = {name: file.get_tensor(name) for name in file.keys()}  # noqa: SIM118
    except (SafetensorError, OSError) as error:
        raise _invalid(path, f"cannot be read ({error}).") from error
    if metadata.get("format") != FORMAT:
        raise _invalid(path, "was written by another version.")
    try:
        return Checkpoint.model_validate({**json.loads(metadata["state"]), "tensors": tensors})
    except (ValidationError, KeyError, ValueError) as error:
        raise _invalid(path, "was written by another version.") from error


def _invalid(path: Path, what: str) -> InputError:
    return InputError("checkpoint_invalid", what, where=str(path), hint=OTHER_FOLDER)
