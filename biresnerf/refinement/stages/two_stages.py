"""The two stages: step, watch the error, switch when it is stable."""

from __future__ import annotations

import logging
import math
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Literal

import numpy as np

from biresnerf.arrays import Array
from biresnerf.data.show.history import HistoryLine
from biresnerf.errors import Interrupted, RefinementError
from biresnerf.geometry.pose_error import rotation_between_deg
from biresnerf.progress import Progress
from biresnerf.refinement.lost.lost_cameras import LostCameraRepair
from biresnerf.refinement.optimise.async_metrics import StepResult
from biresnerf.refinement.optimise.device_memory import step_that_fits
from biresnerf.refinement.optimise.joint_optimiser import JointOptimiser
from biresnerf.refinement.stages.checkpoint import COARSE, Checkpoint
from biresnerf.refinement.stages.run_state import RunState
from biresnerf.refinement.stages.stability import StabilityDetector
from biresnerf.stages import CHECKPOINT, ReusableStage

logger = logging.getLogger(__name__)

REPORT_PERIOD_S = 0.5
MEASURED_STEPS = 20  # of a stage, after which it is known how long they take
FIRST_PREVIEW_S, PREVIEW_PERIOD_S = 3.0, 20.0
PREVIEW_SHARE = 0.05  # of the run's time, at most


class PreviewTimer:
    """Says when a preview is due: soon after the start, then every so often, but never for much of the time.

    Args:
        period_s: seconds from one to the next, `PREVIEW_PERIOD_S` at most.
    """

    def __init__(self, period_s: float) -> None:
        self._period_s, self._due = min(period_s, PREVIEW_PERIOD_S), 0.0

    def begin(self) -> None:
        """Start the clock: the run steps from now on."""
        self._due = time.monotonic() + min(FIRST_PREVIEW_S, self._period_s)

    @property
    def due(self) -> bool:
        return time.monotonic() >= self._due

    @contextmanager
    def showing(self) -> Iterator[None]:
        """Context of writing a preview: the longer it takes, the later the next one comes."""
        started = time.monotonic()
        yield
        now = time.monotonic()
        self._due = now + max(self._period_s, (now - started) / PREVIEW_SHARE)


class TwoStages:
    """Runs a `JointOptimiser` to its last step; can stop after any step and continue from a checkpoint.

    Args:
        at_check: called with the poses at each check; its result joins that check's line of the history.
        write_preview: shows the run in files, and returns these relative to the output folder.
    """

    def __init__(
        self,
        optimiser: JointOptimiser,
        repair: LostCameraRepair,
        run: RunState,
        at_check: Callable[[Array], dict[str, float]] = lambda _unit_from_cam: {},
        write_preview: Callable[[], tuple[str, ...]] = lambda: (),
    ) -> None:
        self.optimiser, self.repair, self.run = optimiser, repair, run
        self._at_check, self._write_preview = at_check, write_preview
        self.detector = StabilityDetector(0, 0, optimiser.method.switch)
        self._take_lengths()
        self._previews = PreviewTimer(optimiser.options.checkpoint_every_s)
        self._reported = self._saved = 0.0
        self._errors: list[float] = []
        self._losses: list[float] = []
        self._moved_deg = 0.0
        self._signal: dict[str, float] = {}
        self._poses_at_check = optimiser.poses.poses()
        self._reusable: dict[ReusableStage, tuple[str, ...]] = {}

    @property
    def stage(self) -> Literal["coarse", "fine"]:
        return "coarse" if self.optimiser.switch is None else "fine"

    def run_stage_1(self) -> None:
        """Step until stage 2 begins; takes no step where it has begun, or the method has one stage only.

        Raises:
            Interrupted: stopped; a checkpoint is written.
            RefinementError: ``diverged``: the error is not a number.
        """
        self._reported = self._saved = time.monotonic()
        self._previews.begin()
        self.run.history.cut(self.optimiser.step_index)
        while self.optimiser.switch is None and self.optimiser.step_index < self.optimiser.schedule.steps:
            self._step()

    def run_stage_2(self, share: float = 1.0) -> None:
        """Step until this share of all steps is taken, and write a checkpoint. Raises as `run_stage_1`."""
        while self.optimiser.step_index < round(share * self.optimiser.schedule.steps):
            self._step()
        # What follows may take long: meanwhile a preview shows the poses, and a stop loses nothing.
        preview = self._preview()
        self._save()
        self.run.report(self._progress(CHECKPOINT.as_posix(), preview))

    def replan(self) -> None:
        """Plan the rest of the run anew, shorter or longer, now that its speed has been measured."""
        self.run.replan()
        self._take_lengths()

    def _take_lengths(self) -> None:
        options = self.optimiser.options
        self.detector.keep_between(options.coarse_steps_min, options.coarse_steps_max)

    def begin_block(self) -> None:
        """Begin a block after cameras were given other poses, so that this does not count as motion within it."""
        self._poses_at_check = self.optimiser.poses.poses()

    def _step(self) -> None:
        """One step, and what is due after it: a check, a checkpoint, a preview, a report."""
        optimiser, options = self.optimiser, self.optimiser.options
        if self.run.monitor.should_stop():
            self._save()
            self.run.report(self._progress(CHECKPOINT.as_posix()))
            raise Interrupted(f"stopped at step {optimiser.step_index}; run again to go on")
        started, stage = time.monotonic(), self.stage
        result = step_that_fits(optimiser)
        # Without the check: the time of a repair within it says nothing about the steps to come.
        self.run.monitor.forecast.stepped(stage, time.monotonic() - started)
        if not math.isfinite(result.loss):
            raise RefinementError("diverged", f"The loss is not a number at step {optimiser.step_index}.")
        if optimiser.step_index - (optimiser.switch or 0) == MEASURED_STEPS:
            self.replan()
        self._errors.append(result.mean_squared_error)
        self._losses.append(result.loss)
        # At the cap, too, where the period does not divide it: stage 2 must not wait for the next check.
        at_cap = optimiser.step_index == self.detector.cap and optimiser.switch is None
        if at_cap or optimiser.step_index % options.check_every == 0:
            self._check(result)
        now = time.monotonic()
        self.run.spent(stage, self.run.record.seconds[stage] + now - started)
        preview = self._preview() if self._previews.due else ()  # first: the checkpoint holds what it found
        checkpoint = None
        if now - self._saved >= options.checkpoint_every_s:
            self._save()
            self._saved, checkpoint = time.monotonic(), CHECKPOINT.as_posix()
        if checkpoint or preview or now - self._reported >= REPORT_PERIOD_S:
            self._reported = now
            self.run.report(self._progress(checkpoint, preview))

    def _preview(self) -> tuple[str, ...]:
        with self._previews.showing():
            return self._write_preview()

    def _check(self, last: StepResult) -> None:
        """The end of a block of steps: the detector decides how to continue."""
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
            self.replan()
            return
        verdict = self.detector.check(optimiser.step_index, error)
        self._signal = self.detector.signal()
        self._write_history(error, last)
        self._repair_if_due(switching=verdict != "running")
        if verdict != "running":
            self.run.note(switch_reason=verdict)
            logger.info("stage 2 begins at step %d (%s)", optimiser.step_index, verdict)
            self._signal = {}
            self._save(ends_stage_1=True)
            self._reusable = {"coarse": (COARSE.as_posix(),)}
            optimiser.start_reconstruction()

    def _repair_if_due(self, *, switching: bool = False) -> None:
        if switching or self.repair.due():
            self.repair.run(switching=switching)
            self.begin_block()

    def _write_history(self, mean_squared_error: float, last: StepResult) -> None:
        optimiser = self.optimiser
        # The error is the mean since the last check; loss, rays and samples are the last step's, rates the next's.
        rates = optimiser.schedule.field_rates(optimiser.step_index, optimiser.switch)
        self.run.history.append(
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
                seconds=round(sum(self.run.record.seconds[stage] for stage in ("coarse", "fine")), 3),
                **{**self._signal, **self._at_check(self._poses_at_check.numpy())},
            ).model_dump(exclude_none=True)
        )

    def _progress(self, checkpoint: str | None, preview: tuple[str, ...] = ()) -> Progress:
        optimiser, steps = self.optimiser, self.optimiser.schedule.steps
        left = self.run.steps_left(optimiser.step_index, optimiser.switch, steps, self.detector.cap)
        self.run.monitor.forecast.plan_steps(*left)
        losses, self._losses = self._losses, []
        reusable, self._reusable = self._reusable, {}
        metrics = {"moved_deg": self._moved_deg, **self._signal}
        metrics |= {"loss": float(np.mean(losses))} if losses else {}
        if self._errors:
            metrics["psnr"] = -10 * math.log10(max(float(np.mean(self._errors)), 1e-12))
        return Progress(
            stage=self.stage,
            step=optimiser.step_index,
            steps_total=steps,
            metrics=metrics,
            checkpoint=checkpoint,
            preview=preview,
            reusable=reusable,
        )

    def _save(self, *, ends_stage_1: bool = False) -> None:
        optimiser = self.optimiser
        state = optimiser.coarse_state() if ends_stage_1 else optimiser.state()
        self.run.save(
            {**state, "poses_at_check": self._poses_at_check},
            ends_stage_1=ends_stage_1,
            optimiser=optimiser.step_state(),
            detector=self.detector.state(),
            repair=self.repair.state(),
            block_errors=tuple(self._errors),
        )

    def restore(self, checkpoint: Checkpoint) -> None:
        """Continue where a checkpoint was written; from the end of stage 1 of another run, begin stage 2."""
        tensors, optimiser = checkpoint.tensors, self.optimiser
        if checkpoint.ends_stage_1:  # it holds nothing of the reconstruction module
            tensors = {**optimiser.state(), **tensors}
        optimiser.load_state(tensors, checkpoint.optimiser)
        self._take_lengths()
        self._poses_at_check, self._errors = tensors["poses_at_check"], list(checkpoint.block_errors)
        self.repair.load_state(checkpoint.repair)
        self.run.restore(checkpoint)
        if checkpoint.ends_stage_1:
            optimiser.start_reconstruction()
        else:
            self.detector.load_state(checkpoint.detector)
