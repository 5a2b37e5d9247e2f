"""`biresnerf refine INPUT --output OUT`."""

from __future__ import annotations

import logging
import signal
import sys
from pathlib import Path
from types import FrameType
from typing import Any

import click
from rich.console import Console
from rich.logging import RichHandler
from rich.progress import BarColumn, TextColumn, TimeElapsedColumn
from rich.progress import Progress as ProgressBar

from biresnerf.commands import exit_codes
from biresnerf.commands.answers import json_option, show
from biresnerf.commands.settings_option import budget_option, settings_option
from biresnerf.data.formats.read_dataset import read_dataset
from biresnerf.errors import Interrupted
from biresnerf.options.presets import PRESETS
from biresnerf.options.refine_options import parse_options
from biresnerf.progress import Progress
from biresnerf.report import Report
from biresnerf.viewer.report_html import REPORT_HTML

LINE_EVERY = 20  # reports of progress between two lines where there is no terminal


class StopRequest:
    """Set by SIGINT and SIGTERM; a second signal ends the process at once."""

    def __init__(self) -> None:
        self.signal: int | None = None
        for number in (signal.SIGINT, signal.SIGTERM):
            signal.signal(number, self._on_signal)

    def _on_signal(self, number: int, _frame: FrameType | None) -> None:
        if self.signal is not None:
            sys.exit(128 + number)
        self.signal = number
        click.echo("stopping: writing checkpoint and partial result …", err=True)

    def __call__(self) -> bool:
        return self.signal is not None


class ProgressPrinter:
    """A bar on a terminal, plain lines elsewhere; on standard error."""

    def __init__(self) -> None:
        self._bar = ProgressBar(
            TextColumn("{task.description:<11}"),
            BarColumn(),
            TextColumn("{task.percentage:>3.0f} %"),
            TimeElapsedColumn(),
            TextColumn("{task.fields[detail]}"),
            console=Console(stderr=True),
            disable=not sys.stderr.isatty(),
            transient=True,
        )
        self._task = self._bar.add_task("preparing", total=1.0, detail="")
        self._lines = not sys.stderr.isatty()
        self._count, self._stage, self._message = 0, "", ""

    def __enter__(self) -> ProgressPrinter:
        self._bar.start()
        return self

    def __exit__(self, *_: object) -> None:
        self._bar.stop()

    def __call__(self, progress: Progress) -> None:
        detail = describe(progress)
        self._bar.update(self._task, completed=progress.fraction, description=progress.stage, detail=detail)
        self._count += 1
        news = progress.stage == "preparing" and progress.message not in {"", self._message}
        if self._lines and (news or progress.stage != self._stage or self._count % LINE_EVERY == 0):
            click.echo(f"{progress.stage:<10} {100 * progress.fraction:3.0f} % {detail}", err=True)
        elif news:
            self._bar.console.print(progress.message, highlight=False)
        self._stage, self._message = progress.stage, progress.message


def describe(progress: Progress) -> str:
    """Step, loss, training PSNR and time left, as far as known."""
    parts = []
    if progress.steps_total:
        parts.append(f"step {progress.step}/{progress.steps_total}")
    if "loss" in progress.metrics:
        parts.append(f"loss {progress.metrics['loss']:.5f}")
    if "psnr" in progress.metrics:
        parts.append(f"train PSNR {progress.metrics['psnr']:.1f} dB")
    if progress.eta_s is not None and progress.eta_s > 0:
        minutes, seconds = divmod(round(progress.eta_s), 60)
        parts.append(f"{minutes}:{seconds:02d} left")
    if progress.message:
        parts.append(progress.message)
    return "  ".join(parts)


@click.command("refine")
@click.argument("input_path", metavar="INPUT", type=click.Path(path_type=Path))
@click.option(
    "--output", "-o", required=True, type=click.Path(path_type=Path), help="Folder for the results."
)
@click.option("--preset", type=click.Choice(list(PRESETS)), default=None, help="Default: balanced.")
@click.option("--device", type=click.Choice(["auto", "cpu", "cuda"]), default=None, help="Default: auto.")
@click.option("--seed", type=int, default=None, help="Default: 0.")
@budget_option
@settings_option
@click.option("--overwrite", is_flag=True, help="Replace a finished result in OUT.")
@click.option("--open", "open_report", is_flag=True, help="Open OUT/report.html in a browser at the end.")
@click.option("--verbose", "-v", is_flag=True, help="Print log messages.")
@json_option
def refine_command(
    input_path: Path,
    output: Path,
    preset: str | None,
    device: str | None,
    seed: int | None,
    time_budget_s: float | None,
    settings: dict[str, Any],
    overwrite: bool,
    open_report: bool,
    verbose: bool,
    as_json: bool,
) -> int:
    """Refine the camera poses of INPUT, a folder of images with or without poses.

    Results go to OUT: transforms.json and colmap/sparse/0 in the input's own frame and scale, report.json,
    renders/ and config.json. --json prints report.json. Run the same command again to resume.
    """
    named = {"preset": preset, "device": device, "seed": seed, "time_budget_s": time_budget_s}
    options = parse_options({**settings, **{key: value for key, value in named.items() if value is not None}})
    logging.basicConfig(
        level=logging.INFO if verbose else logging.WARNING,
        format="%(message)s",
        handlers=[RichHandler(show_path=False)] if sys.stderr.isatty() else None,
    )
    stop = StopRequest()
    try:
        with ProgressPrinter() as printer:
            dataset = read_dataset(input_path, strict=options.bad_frames == "refuse")
            # Loads torch, which takes seconds: errors of the input come before.
            from biresnerf.pipeline import refine_poses

            report = refine_poses(dataset, output, options, printer, stop, overwrite=overwrite)
    except Interrupted as interrupted:
        click.echo(str(interrupted), err=True)
        return 128 + (stop.signal or signal.SIGINT)
    show(report, summary(report, output), as_json=as_json)
    if open_report:
        click.launch(str(output / REPORT_HTML))
    return exit_codes.DONE


def summary(report: Report, output: Path) -> str:
    """The result in a few lines of text."""
    moved = sorted(image.moved_deg for image in report.images)
    lines = report.verdict.in_words() if report.verdict is not None else []
    lines += [
        f"{len(report.images)} cameras, moved by {moved[len(moved) // 2]:.3g} deg (median), {moved[-1]:.3g} deg (most)",
        f"{report.options.method}: {report.steps_done} steps"
        if report.switch_step is None
        else f"stage 2 began at step {report.switch_step} of {report.steps_done} ({report.switch_reason})",
    ]
    if report.heldout:
        lines.append(
            f"held-out views ({report.heldout.count}): "
            f"PSNR {report.heldout.psnr:.2f} dB, SSIM {report.heldout.ssim:.3f}"
        )
        if report.heldout.unshared_opacity is not None:
            lines.append(
                f"{100 * report.heldout.unshared_opacity:.1f} % of what they show lies where no second camera looks"
            )
    lines += [f"warning: {warning}" for warning in report.warnings]
    lines.append(f"time: {sum(report.seconds.values()):.0f} s; results in {output}")
    lines.append(f"report: {output / REPORT_HTML}")
    return "\n".join(lines)
