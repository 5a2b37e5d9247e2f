"""One cell of a comparison as data: scene, start poses, options, and the result."""

from __future__ import annotations

import hashlib
import json
from pathlib import Path
from typing import Literal

from pydantic import Field, JsonValue

from biresnerf.frozen_model import FrozenModel
from biresnerf.geometry.pose_error import PoseError
from biresnerf.options.refine_options import RefineOptions, ResolvedOptions
from biresnerf.report import CandidateName, SwitchReason, VerdictName

LOST_FROM_DEG = 1.0  # a camera this far off after a run counts as not found
TEST_VIEWS = "test views"  # among the seconds
EXIT_STOPPED = 143  # of the process of a cell that was stopped
CELL, RESULT, LOG, RUN = "cell.json", "result.json", "log.txt", "run"  # in the folder of a cell


class Perturbation(FrozenModel):
    """How the start poses of a run are made from the true ones."""

    kind: Literal["noise", "identity"] = "noise"
    noise: float = Field(0.15, ge=0, le=2, description="BARF's sigma.")
    seed: int = Field(1, ge=0)
    turn_one_deg: float = Field(0.0, description="One camera is turned in place by this angle.")
    lose_share: float = Field(0.0, ge=0, le=1, description="Share of the cameras turned about the scene.")

    @property
    def label(self) -> str:
        """All but the seed, as text."""
        parts = ["identity" if self.kind == "identity" else f"noise {self.noise:g}"]
        if self.turn_one_deg:
            parts.append(f"one camera turned by {self.turn_one_deg:g}°")
        if self.lose_share:
            parts.append(f"{100 * self.lose_share:g} % of the cameras lost")
        return ", ".join(parts)


class Scene(FrozenModel):
    """A set of true poses. ``digest`` is of its transforms files: other poses make another scene."""

    name: str
    file: Path = Field(description="Transforms file with true poses.")
    test_file: Path | None = Field(description="Views that no run sees, with true poses.")
    digest: str
    every: int = Field(1, ge=1, description="Every n-th view is used.")
    test_views: int = Field(0, ge=0, description="At most this many views of the test file are rendered.")


class EqualTime(FrozenModel):
    """How the number of steps was chosen for a run that gets the time of the first variant."""

    seconds: float = Field(description="What the first variant took to optimise.")
    calibration_steps: int
    calibration_ms_per_step: float


class Cell(FrozenModel):
    """One run of a comparison."""

    scene: Scene
    start: Perturbation
    options: RefineOptions
    method: dict[str, JsonValue] = Field(
        default_factory=dict, description="What differs from the method that the options name, by its fields."
    )
    equal_time: EqualTime | None = None

    @property
    def key(self) -> str:
        """Hash of all that may change the result: scene content, start, method, and options with presets filled in."""
        content = [
            self.scene.model_dump_json(exclude={"name", "file", "test_file"}),
            self.start.model_dump_json(),
            self.options.device,
            self.options.resolved("cpu").model_dump_json(exclude={"device", "checkpoint_every_s"}),
            json.dumps(self.method, sort_keys=True),
        ]
        return hashlib.sha256("\n".join(content).encode()).hexdigest()[:12]

    @property
    def folder_name(self) -> str:
        return f"{self.scene.name}-{self.key}"


class CameraResult(FrozenModel):
    """Rotation error of one camera after an alignment that is robust to lost cameras."""

    name: str
    displaced: bool = Field(description="Was turned or lost on purpose, on top of the noise.")
    before_deg: float
    after_deg: float


class ViewQuality(FrozenModel):
    """Means over views the field never saw, their poses fitted to it first (BARF's test-time refinement)."""

    kind: Literal["held out", "test"]
    count: int
    psnr: float
    ssim: float
    unshared_opacity: float | None = Field(
        None, description="Share of the rendered opacity where fewer than two training cameras look."
    )
    depth_error: float | None = Field(
        None,
        description="Mean of |z - z*| / z* over the pixels that show something, z* the true depth; of scenes that "
        "make-scene rendered.",
    )
    lpips: float | None = None
    lpips_absent: str | None = Field(None, description="Why there is no LPIPS.")


class Outcome(FrozenModel):
    """The result of a completed run."""

    version: str
    options: ResolvedOptions = Field(description="As used, with all values filled in.")
    before: PoseError
    after: PoseError
    matched: PoseError | None = Field(
        None, description="Of the cameras that COLMAP placed in this run, aligned by them, if it did."
    )
    cameras: tuple[CameraResult, ...]
    views: ViewQuality | None
    verdict: VerdictName | None = None
    chosen: CandidateName | None = None
    switch_step: int | None
    switch_reason: SwitchReason | None
    seconds: dict[str, float] = Field(description="Wall time per stage.")
    peak_memory_bytes: int
    backend: str
    device: str
    threads: int
    resumed: int

    @property
    def optimisation_s(self) -> float:
        return self.seconds["coarse"] + self.seconds["fine"]

    @property
    def run_s(self) -> float:
        """Seconds of the whole run, without measuring it."""
        return sum(seconds for name, seconds in self.seconds.items() if name != TEST_VIEWS)

    @property
    def not_found(self) -> int:
        return sum(camera.after_deg > LOST_FROM_DEG for camera in self.cameras)


class CellResult(FrozenModel):
    """``result.json`` of a cell: its outcome, or the error."""

    cell: Cell
    outcome: Outcome | None = None
    error: str | None = None
