"""A job's progress for people: a bar on a terminal, lines in a pipe."""

from __future__ import annotations

import time
from contextlib import AbstractContextManager
from types import TracebackType
from typing import Protocol

import click
from rich.console import Console
from rich.progress import BarColumn, Progress, TaskID, TextColumn, TimeElapsedColumn

from biresnerf.wire.jobs import JobView
from service.client import Client, Happening

_LINE_EVERY_S = 10.0


class View(Protocol):
    """What shows progress."""

    def job(self, job: JobView) -> None:
        """How far the job is."""

    def note(self, text: str) -> None:
        """Something worth a line."""


class ShownProgress(AbstractContextManager["View"], Protocol):
    """A view that is put up and taken down."""


def progress_view(console: Console) -> ShownProgress:
    """The view that fits the console."""
    return TerminalView(console) if console.is_terminal else LineView()


class TerminalView:
    """One bar with stage, loss and time left."""

    def __init__(self, console: Console) -> None:
        self._bar = Progress(
            TextColumn("[bold]{task.fields[stage]:<10}"),
            BarColumn(bar_width=None),
            TextColumn("{task.percentage:>3.0f}%"),
            TextColumn("{task.fields[numbers]}"),
            TextColumn("left {task.fields[left]}"),
            TimeElapsedColumn(),
            console=console,
        )
        self._task: TaskID | None = None

    def __enter__(self) -> TerminalView:
        self._bar.start()
        self._task = self._bar.add_task("job", total=1.0, stage="waiting", numbers="", left="?")
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._bar.stop()

    def job(self, job: JobView) -> None:
        """How far the job is."""
        if self._task is not None:
            self._bar.update(
                self._task,
                completed=job.progress.fraction,
                stage=_stage(job),
                numbers=_numbers(job),
                left=_left(job),
            )

    def note(self, text: str) -> None:
        """Something worth a line."""
        self._bar.console.print(text, highlight=False)


class LineView:
    """A line at each stage and every few seconds."""

    def __init__(self) -> None:
        self._stage, self._said = "", 0.0

    def __enter__(self) -> LineView:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        return None

    def job(self, job: JobView) -> None:
        """How far the job is."""
        now = time.monotonic()
        if _stage(job) == self._stage and now - self._said < _LINE_EVERY_S:
            return
        self._stage, self._said = _stage(job), now
        click.echo(
            f"{_stage(job):<10} {100 * job.progress.fraction:3.0f} %  {_numbers(job)}  left {_left(job)}",
            err=True,
        )

    def note(self, text: str) -> None:
        """Something worth a line."""
        click.echo(text, err=True)


def watch(client: Client, job: JobView, view: View) -> JobView:
    """Shows the job until it is over; returns it. Raises `ServiceError`."""
    view.job(job)
    for happening in client.follow(job):
        if happening.kind == "progress":
            view.job(JobView.model_validate(happening.data))
        elif (text := _worth_a_line(happening)) is not None:
            view.note(text)
    return client.job(job.id)


def _worth_a_line(happening: Happening) -> str | None:
    if happening.kind == "attempt_crashed":
        return f"Attempt {happening.data.get('attempt')} broke off; the job goes on from its last checkpoint."
    if happening.kind == "cancel_requested":
        return "The job was asked to end."
    return None


def _stage(job: JobView) -> str:
    if job.state == "queued":
        return f"waiting {job.queue_position or ''}".strip()
    return job.stage or job.state


def _numbers(job: JobView) -> str:
    parts = [f"step {job.progress.step}/{job.progress.steps_total}"] if job.progress.steps_total else []
    parts += [f"{name} {job.metrics[name]:.4g}" for name in ("loss", "psnr") if name in job.metrics]
    return "  ".join(parts)


def _left(job: JobView) -> str:
    left = job.progress.eta_s
    if left is None:
        return "?"
    minutes, seconds = divmod(round(left), 60)
    return f"{minutes}:{seconds:02d}"
