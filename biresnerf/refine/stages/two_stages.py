"""The two stages: step, watch the error, switch when it is stable, roll back when it diverges, keep checkpoints."""

from __future__ import annotations

import logging
import math
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any, Literal

import numpy as np
from torch import Tensor

from biresnerf.errors import RefinementError
from biresnerf.geometry.pose_error import rotation_between_deg
from biresnerf.progress import OnProgress, Progress
from biresnerf.refine.lost.lost_cameras import LostCameraRepair
from biresnerf.refine.optimise.async_metrics import StepResult
from biresnerf.refine.optimise.joint_optimiser import JointOptimiser
from biresnerf.refine.stages.checkpoint import CHECKPOINT, COARSE, save_checkpoint
from biresnerf.refine.stages.history import History, HistoryLine, Observer
from biresnerf.refine.stages.previews import Previews
from biresnerf.refine.stages.run_record import RunRecord
from biresnerf.refine.stages.stability import StabilityDetector
from biresnerf.stages import ReusableStage

logger = logging.getLogger(__name__)

ROLLBACKS = 3
SNAPSHOT = "snapshot."  # before the names of its tensors in a checkpoint
REPORT_PERIOD_S = 0.5
FIRST_FRACTION, LAST_FRACTION = 0.03, 0.88  # of the whole run's progress: reading before, evaluation after
FINE_COST = 2.0  # a fine step against a coarse one, until measured


class TwoStages:
    """Runs a `JointOptimiser` to its last step; can stop after any step and go on from a checkpoint.

    Args:
        folder: where checkpoints go.
        fingerprint: of input and options; a checkpoint with another one is not resumed.
        seeding: COLMAP's answer, where poses come from it; goes into every checkpoint.
        start: the poses started from; goes into every checkpoint.
        observer: looks in at every check.
        show: writes a preview and returns its files, relative to `folder`; called on the way and at the end.
        carried: tensors that go into every checkpoint as they are.
        stage_1_fingerprint: the fingerprint without the options that have no say in stage 1.
    """

    def __init__(
        self,
        optimiser: JointOptimiser,
        folder: Path,
        fingerprint: str,
        on_progress: OnProgress,
        should_stop: Callable[[], bool],
        seeding: str | None = None,
        start: dict[str, Any] | None = None,
        observer: Observer | None = None,
        show: Callable[[], tuple[str, ...]] = lambda: (),
        carried: dict[str, Tensor] | None = None,
        stage_1_fingerprint: str = "",
    ) -> None:
        self.optimiser, self.folder = optimiser, folder
        self.history, self.observer = History(folder), observer or Observer()
        self.on_progress, self.should_stop = on_progress, should_stop
        self.previews, self.carried = Previews(show, optimiser.options.checkpoint_every_s), carried or {}
        self.record = RunRecord(fingerprint, stage_1_fingerprint, seeding=seeding, start=start or {})
        self.repair = LostCameraRepair(optimiser)
        options = optimiser.options
        self.detector = StabilityDetector(
            options.coarse_steps_min,
            options.coarse_steps_max,
            options.detector,
            guarded=optimiser.method.additions,
        )
        self._errors: list[float] = []
        self._losses: list[float] = []
        self._moved_deg = 0.0
        self._signal: dict[str, float] = {}
        self._poses_at_check = optimiser.poses.poses()
        self._snapshot: tuple[float, dict[str, Tensor]] | None = None
        self._reusable: dict[ReusableStage, tuple[str, ...]] = {}
        self._step_seconds = {"coarse": 0.0, "fine": 0.0}
        self._fraction = FIRST_FRACTION

    @property
    def stage(self) -> Literal["coarse", "fine"]:
        return "coarse" if self.optimiser.switch is None else "fine"

    def run(self) -> bool:
        """Step to the end; False if stopped before on request. A checkpoint is written either way.

        Raises:
            RefinementError: ``diverged`` when the error is not a number or keeps rising after all rollbacks.
        """
        optimiser, options = self.optimiser, self.optimiser.options
        reported = saved = time.monotonic()
        self.previews.begin()
        self.history.cut(optimiser.step_index)
        while optimiser.step_index < self.optimiser.schedule.steps:
            if self.should_stop():
                self._save()
                self.on_progress(self._progress(CHECKPOINT.as_posix()))
                return False
            started = time.monotonic()
            result = optimiser.step()
            # Without the check: a repair within it says nothing of the steps to come.
            stepped = time.monotonic() - started
            if not math.isfinite(result.loss):
                raise RefinementError("diverged", f"The loss is not a number at step {optimiser.step_index}.")
            self._errors.append(result.mean_squared_error)
            self._losses.append(result.loss)
            stage = self.stage
            # Also where the period does not divide the cap: stage 2 must not wait, or never come.
            due = optimiser.step_index == self.detector.cap and optimiser.switch is None
            if due or optimiser.step_index % options.check_every == 0:
                self._check(result)
            now = time.monotonic()
            self.record.seconds[stage] += now - started
            slow = self._step_seconds[stage]
            self._step_seconds[stage] = stepped if slow == 0 else 0.98 * slow + 0.02 * stepped
            checkpoint = None
            if now - saved >= options.checkpoint_every_s:
                self._save()
                saved, checkpoint = time.monotonic(), CHECKPOINT.as_posix()
            preview = self.previews.if_due()
            if checkpoint or preview or now - reported >= REPORT_PERIOD_S:
                reported = now
                self.on_progress(self._progress(checkpoint, preview))
        self._save()
        # Evaluation may take long; whoever looks, or stops it, finds the final poses.
        self.on_progress(self._progress(CHECKPOINT.as_posix(), self.previews.take()))
        return True

    def _check(self, last: StepResult) -> None:
        """The detector's turn, at the end of each block."""
        optimiser = self.optimiser
        error = float(np.mean(self._errors))
        self._errors = []
        now = optimiser.poses.poses()
        turned = rotation_between_deg(self._poses_at_check.numpy(), now.numpy())
        self._moved_deg = float(np.quantile(turned, 0.9))
        self._poses_at_check = now
        optimiser.camera_errors.close_block()
        if optimiser.switch is not None:
            self._write_history(error, last)
            self._repair_if_due()
            return
        still_deg = self.detector.still_deg(optimiser.pose_rate(), optimiser.options.check_every)
        verdict = self.detector.check(optimiser.step_index, error, self._moved_deg, still_deg)
        self._signal = {"still_deg": still_deg, **self.detector.signal()}
        self._write_history(error, last)
        if verdict == "diverging":
            self._roll_back()
            return
        if self._snapshot is None or error < self._snapshot[0]:
            self._snapshot = (error, {k: v.clone() for k, v in optimiser.coarse_state().items()})
        if verdict in ("stable", "cap"):
            self._repair(switching=True)
            self.record.switch_reason = "stable" if verdict == "stable" else "cap"
            logger.info("stage 2 begins at step %d (%s)", optimiser.step_index, verdict)
            self._snapshot, self._signal = None, {}
            self._save(COARSE)
            self._reusable = {"coarse": (COARSE.as_posix(),)}
            optimiser.start_reconstruction()
        else:
            self._repair_if_due()

    def _repair_if_due(self) -> None:
        if self.repair.due():
            self._repair()

    def _repair(self, *, switching: bool = False) -> None:
        """Lost cameras brought home; what that moves is no motion of the block."""
        self.repair.run(switching=switching)
        self._poses_at_check = self.optimiser.poses.poses()

    def _write_history(self, mean_squared_error: float, last: StepResult) -> None:
        optimiser = self.optimiser
        # The error is the mean since the last check; loss, rays and samples are the last step's, rates the next's.
        rates = optimiser.schedule.field_rates(optimiser.step_index, optimiser.switch)
        self.history.append(
            HistoryLine(
                step=optimiser.step_index,
                stage=self.stage,
                psnr=-10 * math.log10(max(mean_squared_error, 1e-12)),
                loss=last.loss,
                moved_deg=self._moved_deg,
                lost=int(optimiser.camera_errors.lost.sum()),
                rays=last.rays,
                samples=last.samples,
                pose_rate=optimiser.pose_rate(),
                field_rate=rates.pose,
                reconstruction_rate=max(rates.reconstruction, default=0.0),
                seconds=round(sum(self.record.seconds[stage] for stage in ("coarse", "fine")), 3),
                **{**self._signal, **self.observer.at_check(optimiser)},
            ).model_dump(exclude_none=True)
        )

    def _roll_back(self) -> None:
        """Back to the best state so far with half the pose rate (method 4.3, DIVERGE)."""
        self.record.rollbacks += 1
        if self.record.rollbacks > ROLLBACKS or self._snapshot is None:
            raise RefinementError("diverged", f"The error keeps rising at step {self.optimiser.step_index}.")
        logger.warning("error rises at step %d: rolling back", self.optimiser.step_index)
        self.optimiser.load_coarse_state(self._snapshot[1])
        self.optimiser.pose_scale *= 0.5
        self.detector.clear()
        self._poses_at_check = self.optimiser.poses.poses()

    def _progress(self, checkpoint: str | None, preview: tuple[str, ...] = ()) -> Progress:
        optimiser, options = self.optimiser, self.optimiser.options
        done, total = optimiser.step_index, optimiser.schedule.steps
        coarse = self._step_seconds["coarse"] or self._step_seconds["fine"] / FINE_COST
        fine = self._step_seconds["fine"] or coarse * FINE_COST
        switch = options.coarse_steps_max if optimiser.switch is None else optimiser.switch
        left = max(0, switch - done) * coarse + (total - max(done, switch)) * fine
        spent = sum(self.record.seconds.values())
        share = spent / max(spent + left, 1e-9)
        # An early switch makes what is left dearer; the fraction told never falls all the same.
        self._fraction = max(self._fraction, FIRST_FRACTION + (LAST_FRACTION - FIRST_FRACTION) * share)
        losses, self._losses = self._losses, []
        reusable, self._reusable = self._reusable, {}
        metrics = {"moved_deg": self._moved_deg, **self._signal}
        if losses:
            metrics["loss"] = float(np.mean(losses))
        if self._errors:
            metrics["psnr"] = -10 * math.log10(max(float(np.mean(self._errors)), 1e-12))
        return Progress(
            stage="coarse" if optimiser.switch is None else "fine",
            step=done,
            steps_total=total,
            fraction=self._fraction,
            eta_s=left * (1 - FIRST_FRACTION) / (LAST_FRACTION - FIRST_FRACTION),
            metrics=metrics,
            checkpoint=checkpoint,
            preview=preview,
            reusable=reusable,
        )

    def _save(self, name: Path = CHECKPOINT) -> None:
        record, detector = self.record, self.detector
        notes: dict[str, Any] = {
            **record.notes(),
            "detector": {
                "decibels": detector.decibels,
                "confirmed": detector.confirmed,
                "rising": detector.rising,
            },
            "errors": self._errors,
            "repair": self.repair.notes(),
            "optimiser": self.optimiser.notes(),
        }
        state = self.optimiser.state() if name == CHECKPOINT else self.optimiser.coarse_state()
        tensors = {**self.carried, **state, "poses_at_check": self._poses_at_check}
        if self._snapshot is not None:
            notes["snapshot_error"] = self._snapshot[0]
            tensors.update({SNAPSHOT + name: tensor for name, tensor in self._snapshot[1].items()})
        save_checkpoint(self.folder, tensors, notes, name)

    def resume(self, tensors: dict[str, Tensor], notes: dict[str, Any]) -> None:
        """Go on where a checkpoint left off."""
        snapshot = {k.removeprefix(SNAPSHOT): v for k, v in tensors.items() if k.startswith(SNAPSHOT)}
        if snapshot:
            self._snapshot = (notes["snapshot_error"], snapshot)
        self.optimiser.load_state(
            {k: v for k, v in tensors.items() if not k.startswith(SNAPSHOT)}, notes["optimiser"]
        )
        self._take_up(tensors, notes)
        self.record.resumed += 1
        for key, value in notes["detector"].items():
            setattr(self.detector, key, value)

    def begin_stage_2(self, tensors: dict[str, Tensor], notes: dict[str, Any]) -> None:
        """Begin where stage 1 of another run ended, which differs in options of stage 2 alone."""
        self.optimiser.load_state({**self.optimiser.state(), **tensors}, notes["optimiser"])
        self._take_up(tensors, notes)
        self.optimiser.start_reconstruction()

    def _take_up(self, tensors: dict[str, Tensor], notes: dict[str, Any]) -> None:
        self._poses_at_check = tensors["poses_at_check"]
        self._errors = notes["errors"]
        self.repair.load_notes(notes["repair"])
        self.record.take(notes)
