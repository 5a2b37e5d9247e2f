"""Progress on standard error: bars on a terminal, plain lines elsewhere."""

from __future__ import annotations

import time
from threading import Lock
from types import TracebackType
from typing import TYPE_CHECKING, Self

import click
from rich.console import Console
from rich.progress import BarColumn, DownloadColumn, Progress, ProgressColumn, TextColumn, TimeElapsedColumn

from biresnerf.wire.jobs import JobView

if TYPE_CHECKING:
    from biresnerf.client import Client, Sending, StreamEvent

_LINE_EVERY_S = 10.0


class _View:
    """A bar on a terminal, nothing elsewhere."""

    def __init__(self, *columns: ProgressColumn) -> None:
        console = Console(stderr=True)
        self._bar = Progress(*columns, console=console) if console.is_terminal else None

    def __enter__(self) -> Self:
        if self._bar is not None:
            self._bar.start()
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        if self._bar is not None:
            self._bar.stop()

    def note(self, text: str) -> None:
        """Prints a line."""
        if self._bar is not None:
            self._bar.console.print(text, highlight=False, markup=False)
        else:
            click.echo(text, err=True)


class JobProgressView(_View):
    """Stage, step, loss and time left of a job; without a terminal a line at each stage and every 10 seconds."""

    def __init__(self) -> None:
        super().__init__(
            TextColumn("{task.fields[stage]:<10}", markup=False),
            BarColumn(bar_width=None),
            TextColumn("{task.percentage:>3.0f}%"),
            TextColumn("{task.fields[numbers]}", markup=False),
            TextColumn("left {task.fields[left]}"),
            TimeElapsedColumn(),
        )
        self._stage, self._printed_at = "", 0.0
        if self._bar is not None:
            self._task = self._bar.add_task("job", total=1.0, stage="waiting", numbers="", left="?")

    def job(self, job: JobView) -> None:
        """Shows the job's progress."""
        stage, numbers, left = stage_of(job), numbers_of(job), left_of(job)
        fraction = job.progress.fraction
        if self._bar is not None:
            self._bar.update(self._task, completed=fraction, stage=stage, numbers=numbers, left=left)
            return
        now = time.monotonic()
        if stage != self._stage or now - self._printed_at >= _LINE_EVERY_S:
            self._stage, self._printed_at = stage, now
            self.note(f"{stage:<10} {100 * fraction:3.0f} %  {numbers}  left {left}")


class BytesView(_View):
    """Bytes sent or received; without a terminal a line every 10 seconds."""

    def __init__(self, title: str) -> None:
        super().__init__(
            TextColumn("{task.description:<11}"),
            BarColumn(bar_width=None),
            DownloadColumn(),
            TimeElapsedColumn(),
        )
        self._title, self._done, self._printed_at, self._lock = title, 0, time.monotonic(), Lock()
        if self._bar is not None:
            self._task = self._bar.add_task(title, total=None)

    def more(self, count: int, total: int) -> None:
        """Counts ``count`` further bytes of ``total``."""
        with self._lock:
            self._done += count
            self._show(total)

    def _show(self, total: int) -> None:
        if self._bar is not None:
            self._bar.update(self._task, description=self._title, completed=self._done, total=total)
            return
        now = time.monotonic()
        if now - self._printed_at >= _LINE_EVERY_S:
            self._printed_at = now
            self.note(f"{self._title} {self._done / 1e6:.1f} of {total / 1e6:.1f} MB")


class SendingView(BytesView):
    """The steps of a submission, and the bytes sent."""

    def __init__(self) -> None:
        super().__init__("reading")

    def sending(self, sending: Sending) -> None:
        """Shows the submission's progress."""
        begins, self._title, self._done = sending.step != self._title, sending.step, sending.bytes_sent
        if begins and sending.step == "sending":
            there = sending.files - sending.files_missing
            known = f"; the service has {there} already" if there else ""
            size = f"{sending.bytes_missing / 1e6:.1f} MB"
            self.note(f"sending {sending.files_missing} of {sending.files} files, {size}{known}")
        elif begins and sending.step == "fetching":
            self.note(f"the service fetches {sending.files_missing} files")
        elif begins and sending.step == "checking":
            self.note("checking the files")
        self._show(sending.bytes_missing)


def watch(client: Client, job: JobView, view: JobProgressView, timeout_s: float | None = None) -> JobView:
    """Shows the job until it is over; returns it. Raises `ServiceError`, `JobNotOver`."""
    view.job(job)
    for event in client.events(job.id, timeout_s=timeout_s):
        if (now := event.job) is not None:
            view.job(now)
        elif (text := _line_of_event(event)) is not None:
            view.note(text)
    return client.job(job.id)


def _line_of_event(event: StreamEvent) -> str | None:
    if event.kind == "attempt_crashed":
        return f"Attempt {event.data.get('attempt')} crashed; the job continues from its last checkpoint."
    if event.kind == "retried_smaller":
        return "It ran out of memory; the job starts again with smaller settings."
    said = event.data.get("data", {})
    if event.kind == "split":
        return f"Any workers refine the set in {said.get('parts')} parts; then the job joins them."
    if event.kind == "part_over":
        return f"{said.get('over')} of {said.get('parts')} parts are over."
    if event.kind == "cancel_requested":
        return "Cancellation was requested."
    return None


def stage_of(job: JobView) -> str:
    """Its place in the queue, its stage, or its final state."""
    if job.state == "queued":
        return f"waiting {job.queue_position or ''}".strip()
    return job.state if job.final else job.stage or job.state


def numbers_of(job: JobView) -> str:
    """Step, loss and PSNR, as far as known."""
    parts = [f"step {job.progress.step}/{job.progress.steps_total}"] if job.progress.steps_total else []
    parts += [f"{name} {job.metrics[name]:.4g}" for name in ("loss", "psnr") if name in job.metrics]
    return "  ".join(parts)


def left_of(job: JobView) -> str:
    """Minutes and seconds left."""
    left = job.progress.eta_s
    if left is None:
        return "?"
    minutes, seconds = divmod(round(left), 60)
    return f"{minutes}:{seconds:02d}" + (
        " (its machine is busy now)" if job.metrics.get("machine_busy") else ""
    )
