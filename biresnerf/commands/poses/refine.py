"""`biresnerf refine INPUT --output OUT`."""

from __future__ import annotations

import logging
import signal
from contextlib import ExitStack
from pathlib import Path
from typing import Any

import click

from biresnerf.commands import exit_codes
from biresnerf.commands.answers import json_option, show
from biresnerf.commands.settings_option import budget_option, settings_option
from biresnerf.errors import InputError, Interrupted
from biresnerf.options.presets import PRESET_IF_LEFT_OUT, PRESETS
from biresnerf.options.refine_options import parse_options
from biresnerf.report import Report
from biresnerf.run.stop_request import StopRequest
from biresnerf.viewer.report_html import REPORT_HTML


@click.command("refine")
@click.argument("input_path", metavar="INPUT", type=click.Path(path_type=Path))
@click.option(
    "--output", "-o", required=True, type=click.Path(path_type=Path), help="Folder for the results."
)
@click.option("--preset", type=click.Choice(list(PRESETS)), help=f"Default: {PRESET_IF_LEFT_OUT}.")
@click.option("--device", type=click.Choice(["auto", "cpu", "cuda"]), default=None, help="Default: auto.")
@click.option("--seed", type=int, default=None, help="Default: 0.")
@budget_option
@settings_option
@click.option(
    "--fixed-from", type=click.Path(path_type=Path),
    help="A finished result of some of the photos: they keep its poses and lenses, and the others join its frame.",
)  # fmt: skip
@click.option(
    "--photos-from", type=click.Path(path_type=Path),
    help="A file with the names of the photos to use, one a line, as `split` writes them; the option `photos`.",
)  # fmt: skip
@click.option(
    "--join", "parts", multiple=True, type=click.Path(path_type=Path),
    help="The result of a part of the photos (see `split`), or a folder of such; may be repeated. They are joined.",
)  # fmt: skip
@click.option("--overwrite", is_flag=True, help="Replace a finished result in OUT.")
@click.option("--open", "open_report", is_flag=True, help="Open OUT/report.html in a browser at the end.")
@click.option("--view", is_flag=True, help="Show the cameras in the browser while they move; needs viser.")
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
    fixed_from: Path | None,
    photos_from: Path | None,
    parts: tuple[Path, ...],
    overwrite: bool,
    open_report: bool,
    view: bool,
    verbose: bool,
    as_json: bool,
) -> int:
    """Refine the camera poses of INPUT, a folder of images with or without poses, or a video.

    Results go to OUT: transforms.json and colmap/sparse/0 in the input's own frame and scale, and report.html,
    which shows whether the poses improved. --json prints report.json. Run the same command again to resume.
    """
    named = {"preset": preset, "device": device, "seed": seed, "time_budget_s": time_budget_s}
    options = {**settings, **{key: value for key, value in named.items() if value is not None}}
    if photos_from is not None:
        options["photos"] = _lines(photos_from)
    logging.basicConfig(level=logging.INFO if verbose else logging.WARNING, format="%(message)s")
    parse_options(options)  # what is no option must not be taken for another argument
    from biresnerf.run.refine import refine

    with StopRequest(signal.SIGINT, signal.SIGTERM) as stop, ExitStack() as during:
        if view:
            from biresnerf.live_view.live_view import LiveView, shown_live

            live = during.enter_context(shown_live(LiveView(output, input_path)))
            click.echo(f"view at {live.url}", err=True)
        try:
            result = refine(
                input_path,
                output,
                progress=True,
                should_stop=stop,
                overwrite=overwrite,
                fixed_from=fixed_from,
                parts=parts,
                **options,
            )
        except Interrupted as interrupted:
            click.echo(str(interrupted), err=True)
            return 128 + (stop.signal or signal.SIGINT)
    report = result.report
    show(report, summary(report, output), as_json=as_json)
    if open_report:
        click.launch(str(output / REPORT_HTML))
    return exit_codes.DONE


def _lines(path: Path) -> list[str]:
    """The lines of a file that hold something."""
    try:
        return [line.strip() for line in path.read_text("utf-8").splitlines() if line.strip()]
    except (OSError, ValueError) as error:
        raise InputError("invalid_options", f"cannot be read ({error}).", where=str(path)) from error


def summary(report: Report, output: Path) -> str:
    """The result in a few lines of text."""
    moved = sorted(image.moved_deg for image in report.images)
    lines = [f"FAILED: {fault}" for fault in report.faults]
    lines += report.verdict.in_words() if report.verdict is not None else []
    lines += [
        f"{len(report.images)} cameras, moved by {moved[len(moved) // 2]:.3g} deg (median), {moved[-1]:.3g} deg (most)",
        f"{report.options.method}: {report.steps_done} steps"
        if report.switch_step is None
        else f"stage 2 began at step {report.switch_step} of {report.steps_done}, "
        + ("when the error was stable" if report.switch_reason == "stable" else "the step limit"),
    ]
    if report.heldout:
        lines.append(
            f"final render (unseen views: {report.heldout.count}): "
            f"PSNR {report.heldout.psnr:.2f} dB, SSIM {report.heldout.ssim:.3f}"
        )
        if report.heldout.unshared_opacity is not None:
            lines.append(
                f"{100 * report.heldout.unshared_opacity:.1f} % of that render lies where no second camera looks"
            )
    if report.parts is not None and report.parts.seams:
        apart = sorted(seam.rotation_deg for seam in report.parts.seams)
        agree = f"they agree to {apart[len(apart) // 2]:.2g} deg (median)"
        lines.append(f"{len(report.parts.parts)} parts; on the photos that two have {agree}")
    lines += [f"warning: {warning}" for warning in report.warnings]
    lines.append(f"time: {sum(report.seconds.values()):.0f} s; results in {output}")
    if (output / REPORT_HTML).is_file():
        lines.append(f"report: {output / REPORT_HTML}")
    return "\n".join(lines)
