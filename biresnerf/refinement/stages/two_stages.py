"""The two stages: step, watch the error, switch when it is stable, keep checkpoints."""

from __future__ import annotations

import logging
import math
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch
from numpy.typing import NDArray

from biresnerf.data.show.history import History, HistoryLine
from biresnerf.errors import Interrupted, RefinementError
from biresnerf.forecast.run_forecast import Phase
from biresnerf.geometry.pose_error import rotation_between_deg
from biresnerf.progress import Monitor, Progress
from biresnerf.refinement.lost.lost_cameras import LostCameraRepair
from biresnerf.refinement.lost.own_matches import OwnMatches
from biresnerf.refinement.optimise.async_metrics import StepResult
from biresnerf.refinement.optimise.device_memory import step_that_fits
from biresnerf.refinement.optimise.joint_optimiser import JointOptimiser
from biresnerf.refinement.scene.scene import Scene
from biresnerf.refinement.stages.checkpoint import (
    CHECKPOINT,
    COARSE,
    Checkpoint,
    RunOrigin,
    RunRecord,
    save_checkpoint,
    track_tensors,
)
from biresnerf.refinement.stages.stability import StabilityDetector
from biresnerf.refinement.stages.timing import Part, PreviewTimer, StageName
from biresnerf.stages import ReusableStage

logger = logging.getLogger(__name__)

REPORT_PERIOD_S = 0.5
MEASURED_STEPS = 20  # of a stage, after which it is known how long they take


@dataclass(frozen=True)
class Observer:
    """Looks into a run on its way; the run does not depend on what it sees.

    Attributes:
        at_check: what it returns at each check joins that check's line of the history.
        at_end: called once, when the poses are final.
        write_preview: shows the state of the run in files, and returns these relative to the output folder.
    """

    at_check: Callable[[JointOptimiser], dict[str, float]] = lambda _optimiser: {}
    at_end: Callable[[TwoStages], None] = lambda _stages: None
    write_preview: Callable[[TwoStages], tuple[str, ...]] = lambda _stages: ()


class TwoStages:
    """Runs a `JointOptimiser` to its last step; can stop after any step and continue from a checkpoint.

    Args:
        folder: where checkpoints and the history go.
        origin: what the run was started with; goes into every checkpoint.

    Attributes:
        ends: of `time.monotonic`, when the run is to end.
    """

    def __init__(
        self,
        optimiser: JointOptimiser,
        scene: Scene,
        folder: Path,
        origin: RunOrigin = RunOrigin(),
        monitor: Monitor | None = None,
        observer: Observer = Observer(),
    ) -> None:
        self.optimiser, self.scene, self.folder, self.origin = optimiser, scene, folder, origin
        self.monitor, self.observer = monitor or Monitor(), observer
        self.forecast = self.monitor.forecast
        self._plan: Callable[[TwoStages], None] = lambda _stages: None
        self.ends = math.inf
        self.record, self.history = RunRecord(), History(folder)
        self.repair = LostCameraRepair(optimiser, OwnMatches.of(scene))
        self.detector = StabilityDetector(0, 0, guarded=optimiser.method.guard)
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
    def stage(self) -> StageName:
        return "coarse" if self.optimiser.switch is None else "fine"

    def run_stage_1(self) -> None:
        """Step until stage 2 begins; takes no step where it has begun, or the method has one stage only.

        Raises:
            Interrupted: stopped; a checkpoint is written.
            RefinementError: ``diverged``: the error is not a number.
        """
        self._reported = self._saved = time.monotonic()
        self._previews.begin()
        self.history.cut(self.optimiser.step_index)
        while self.optimiser.switch is None and self.optimiser.step_index < self.optimiser.schedule.steps:
            self._step()

    def run_stage_2(self, share: float = 1.0) -> None:
        """Step until this share of all steps is taken, and write a checkpoint. Raises as `run_stage_1`."""
        while self.optimiser.step_index < round(share * self.optimiser.schedule.steps):
            self._step()
        # What follows may take long: meanwhile a preview shows the poses, and a stop loses nothing.
        preview = self._preview()
        self._save()
        self.monitor.report(self._progress(CHECKPOINT.as_posix(), preview))

    def keep_to(self, plan: Callable[[TwoStages], None], ends: float = math.inf) -> None:
        """Plan the rest of the run anew whenever more is known of it, to end by so much of `time.monotonic`.

        Args:
            plan: called when it is known how long the steps of a stage take, after cameras were adjusted, and at each
                check of stage 2; it may change how many steps the run takes.
        """
        self._plan, self.ends = plan, ends

    def note(self, **happened: object) -> None:
        """Put into the record what has happened."""
        self.record = self.record.model_copy(update=happened)

    def spent(self, part: str, seconds: float) -> None:
        """A part of the run has taken so long in all."""
        self.note(seconds={**self.record.seconds, part: seconds})

    def replan(self) -> None:
        """The rest of the run may become shorter or longer: how long it takes has been measured."""
        self._plan(self)
        self._take_lengths()

    def _take_lengths(self) -> None:
        options = self.optimiser.options
        self.detector.keep_between(options.coarse_steps_min, options.coarse_steps_max)

    def steps_left(self, steps: int, cap: int) -> tuple[int, int]:
        """Of stage 1, at most, and of stage 2, in a run of so many steps whose stage 1 has at most `cap`."""
        step, switch = self.optimiser.step_index, self.optimiser.switch
        end = steps if self.record.adjusted else max(step, round(self.forecast.share * steps))
        begin = min(cap if switch is None else switch, end)
        return max(0, begin - step), max(0, end - max(step, begin))

    def place(self, unit_from_cam: NDArray[np.float64]) -> None:
        """Move all cameras to other poses [n, 4, 4]; that does not count as motion within the block."""
        self.optimiser.poses.place(torch.from_numpy(unit_from_cam))
        self._poses_at_check = self.optimiser.poses.poses()

    def announce(self, message: str) -> None:
        """Report what is done between steps."""
        self.monitor.report(self._progress(None).model_copy(update={"message": message}))

    @contextmanager
    def timed(self, part: Part, phase: Phase | None = None, amount: float | None = None) -> Iterator[None]:
        """Around a part of the run besides its steps: its seconds are recorded if it ends without an error.

        It is a phase of the forecast, of its own name if not given, or so much of it.
        """
        started = time.monotonic()
        with self.forecast.within(phase or part, amount):
            yield
        self.spent(part, self.record.seconds.get(part, 0.0) + time.monotonic() - started)

    def report_evaluation(self, share: float, step: int = 0, steps_total: int = 0, message: str = "") -> None:
        """Report how much is done of the part that the run is in, after the stages."""
        self.forecast.advance(share)
        self.monitor.report(Progress(stage="evaluating", step=step, steps_total=steps_total, message=message))

    def _step(self) -> None:
        """One step, and what is due after it: a check, a checkpoint, a preview, a report."""
        optimiser, options = self.optimiser, self.optimiser.options
        if self.monitor.should_stop():
            self._save()
            self.monitor.report(self._progress(CHECKPOINT.as_posix()))
            raise Interrupted(f"stopped at step {optimiser.step_index}; run again to go on")
        started, stage = time.monotonic(), self.stage
        result = step_that_fits(optimiser)
        # Without the check: the time of a repair within it says nothing about the steps to come.
        self.forecast.stepped(stage, time.monotonic() - started)
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
        self.spent(stage, self.record.seconds[stage] + now - started)
        preview = self._preview() if self._previews.due else ()  # first: the checkpoint holds what it found
        checkpoint = None
        if now - self._saved >= options.checkpoint_every_s:
            self._save()
            self._saved, checkpoint = time.monotonic(), CHECKPOINT.as_posix()
        if checkpoint or preview or now - self._reported >= REPORT_PERIOD_S:
            self._reported = now
            self.monitor.report(self._progress(checkpoint, preview))

    def _preview(self) -> tuple[str, ...]:
        with self._previews.showing():
            return self.observer.write_preview(self)

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
        still_deg = self.detector.still_deg(optimiser.pose_rate(), optimiser.options.check_every)
        verdict = self.detector.check(optimiser.step_index, error, self._moved_deg, still_deg)
        self._signal = {"still_deg": still_deg, **self.detector.signal()}
        self._write_history(error, last)
        if verdict != "running":
            self._repair(switching=True)
            self.note(switch_reason=verdict)
            logger.info("stage 2 begins at step %d (%s)", optimiser.step_index, verdict)
            self._signal = {}
            self._save(ends_stage_1=True)
            self._reusable = {"coarse": (COARSE.as_posix(),)}
            optimiser.start_reconstruction()
        else:
            self._repair_if_due()

    def _repair_if_due(self) -> None:
        if self.repair.due():
            self._repair()

    def _repair(self, *, switching: bool = False) -> None:
        """Give lost cameras other poses; that does not count as motion within the block."""
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

    def _progress(self, checkpoint: str | None, preview: tuple[str, ...] = ()) -> Progress:
        self.forecast.plan_steps(*self.steps_left(self.optimiser.schedule.steps, self.detector.cap))
        losses, self._losses = self._losses, []
        reusable, self._reusable = self._reusable, {}
        metrics = {"moved_deg": self._moved_deg, **self._signal}
        metrics |= {"loss": float(np.mean(losses))} if losses else {}
        if self._errors:
            metrics["psnr"] = -10 * math.log10(max(float(np.mean(self._errors)), 1e-12))
        return Progress(
            stage=self.stage,
            step=self.optimiser.step_index,
            steps_total=self.optimiser.schedule.steps,
            metrics=metrics,
            checkpoint=checkpoint,
            preview=preview,
            reusable=reusable,
        )

    def _save(self, *, ends_stage_1: bool = False) -> None:
        state = self.optimiser.coarse_state() if ends_stage_1 else self.optimiser.state()
        tensors = {**track_tensors(self.scene.tracks), **state, "poses_at_check": self._poses_at_check}
        checkpoint = Checkpoint(
            ends_stage_1=ends_stage_1,
            origin=self.origin,
            start=self.scene.start,
            record=self.record,
            optimiser=self.optimiser.step_state(),
            detector=self.detector.state(),
            repair=self.repair.state(),
            block_errors=tuple(self._errors),
            tensors=tensors,
        )
        save_checkpoint(self.folder, checkpoint)

    def restore(self, checkpoint: Checkpoint) -> None:
        """Continue where a checkpoint was written; from the end of stage 1 of another run, begin stage 2."""
        tensors, optimiser = checkpoint.tensors, self.optimiser
        if checkpoint.ends_stage_1:  # it holds nothing of the reconstruction module
            tensors = {**optimiser.state(), **tensors}
        optimiser.load_state(tensors, checkpoint.optimiser)
        self._take_lengths()
        self._poses_at_check, self._errors = tensors["poses_at_check"], list(checkpoint.block_errors)
        self.repair.load_state(checkpoint.repair)
        self.record = checkpoint.record
        if checkpoint.ends_stage_1:
            optimiser.start_reconstruction()
            return
        self.detector.load_state(checkpoint.detector)
        self.note(resumed=self.record.resumed + 1)
