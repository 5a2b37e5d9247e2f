"""What a run keeps and reports beside its steps: its record, curve and checkpoints, and when it is to end."""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path

from torch import Tensor

from biresnerf.data.show.history import History
from biresnerf.forecast.run_forecast import Phase
from biresnerf.progress import Monitor, Progress
from biresnerf.refinement.scene.scene import Scene
from biresnerf.refinement.stages.checkpoint import (
    Checkpoint,
    RunOrigin,
    RunRecord,
    save_checkpoint,
    track_tensors,
)


class RunState:
    """How far a run is, beside its steps. It alone writes the record, the curve, checkpoints and the time to end.

    Args:
        folder: where checkpoints and the history go.
        scene: its start and tracks go into every checkpoint.
        origin: what the run was started with; goes there, too.

    Attributes:
        monitor: the callbacks of a caller that follows the run.
        record: what has happened in it.
        history: its curve.
        ends: of `time.monotonic`, when it is to end.
        replan: called when it is known how long the steps of a stage take, after cameras were adjusted, and at each
            check of stage 2; may change how many steps the run takes.
    """

    def __init__(self, folder: Path, scene: Scene, origin: RunOrigin, monitor: Monitor) -> None:
        self.monitor, self.record, self.history, self.ends = monitor, RunRecord(), History(folder), math.inf
        self._folder, self._scene, self._origin = folder, scene, origin
        self.replan: Callable[[], None] = lambda: None
        self._latest = Progress(stage="coarse")

    def note(self, **happened: object) -> None:
        """Put into the record what has happened."""
        self.record = self.record.model_copy(update=happened)

    def spent(self, part: str, seconds: float) -> None:
        """Record how long a part of the run has taken in all."""
        self.note(seconds={**self.record.seconds, part: seconds})

    @contextmanager
    def timed(self, part: Phase, phase: Phase | None = None, amount: float | None = None) -> Iterator[None]:
        """Context of a part of the run besides its steps: its seconds are recorded if it ends without an error.

        It is ``amount`` of a phase of the forecast, by default all of the phase of the same name.
        """
        started = time.monotonic()
        with self.monitor.forecast.within(phase or part, amount):
            yield
        self.spent(part, self.record.seconds.get(part, 0.0) + time.monotonic() - started)

    def keep_to(self, plan: Callable[[], None], ends: float = math.inf) -> None:
        """Plan the rest of the run anew whenever more is known of it, to end by so much of `time.monotonic`."""
        self.replan, self.ends = plan, ends

    @property
    def left_s(self) -> float:
        """Seconds to when it is to end."""
        return self.ends - time.monotonic()

    def steps_left(self, step: int, switch: int | None, steps: int, cap: int) -> tuple[int, int]:
        """The steps left of stage 1, at most, and of stage 2, in a run of `steps` whose stage 1 has at most `cap`."""
        end = steps if self.record.adjusted else max(step, round(self.monitor.forecast.share * steps))
        begin = min(cap if switch is None else switch, end)
        return max(0, begin - step), max(0, end - max(step, begin))

    def report(self, progress: Progress) -> None:
        """Report steps."""
        metrics = {name: figure for name, figure in progress.metrics.items() if name != "loss"}
        self._latest = Progress(
            stage=progress.stage, step=progress.step, steps_total=progress.steps_total, metrics=metrics
        )
        self.monitor.report(progress)

    def announce(self, message: str) -> None:
        """Report what is done between steps."""
        self.monitor.report(self._latest.model_copy(update={"message": message}))

    def report_evaluation(self, share: float, step: int = 0, steps_total: int = 0, message: str = "") -> None:
        """Report how much is done of the part that the run is in, after the stages."""
        self.monitor.forecast.advance(share)
        self.monitor.report(Progress(stage="evaluating", step=step, steps_total=steps_total, message=message))

    def save(self, tensors: dict[str, Tensor], **steps: object) -> None:
        """Write a checkpoint with these fields of `Checkpoint`, which say how far the steps are."""
        own = {"origin": self._origin, "start": self._scene.start, "record": self.record}
        tensors = {**track_tensors(self._scene.tracks), **tensors}
        save_checkpoint(self._folder, Checkpoint.model_validate({**own, **steps, "tensors": tensors}))

    def restore(self, checkpoint: Checkpoint) -> None:
        """Continue the record of a checkpoint; one that ends stage 1 is of another run."""
        self.record = checkpoint.record
        if not checkpoint.ends_stage_1:
            self.note(resumed=self.record.resumed + 1)
