"""`biresnerf demo`: a whole job over HTTP, from images with wrong poses to images with refined ones.

Starts a temporary service, sends a scene whose true poses are known (or the user's), shows the progress,
fetches the results, measures them, and stops the service.
"""

from __future__ import annotations

import json
import os
import shutil
import statistics
import subprocess
import sys
from pathlib import Path
from typing import Any

import click

from biresnerf.client.scene import look_at
from biresnerf.commands.jobs.follow_job import fetch, require_success
from biresnerf.commands.jobs.job_progress import JobProgressView, SendingView, watch
from biresnerf.commands.jobs.service_options import service_at
from biresnerf.errors import BiresnerfError, InputError
from biresnerf.options.refine_options import RefineOptions
from biresnerf.report import Report
from service.commands.temporary_service import temporary_service

# Marks a folder that a later run may clear.
_MARK = ".made-by-biresnerf-demo"


def run_demo(scene: Path | None, output: Path, options: RefineOptions, views: int, size: int) -> None:
    """Runs the demo; all its files are in ``output`` afterwards. Raises `BiresnerfError`."""
    output = output.resolve()
    if scene is not None:
        look_at(scene)  # raises if the scene cannot be used
    _clear(output)
    given = scene or _make_scene(output / "scene", views, size)
    result = output / "result"
    with temporary_service() as url:
        click.echo(f"service, while this runs: {url}  (its page; API docs: {url}/docs)")
        _send_and_fetch(url, given, result, options)
    _print_outcome(result, given, None if scene else output / "scene.truth.json")


def _clear(output: Path) -> None:
    if output.exists() and not (output / _MARK).exists() and (not output.is_dir() or any(output.iterdir())):
        raise InputError(
            "output_not_empty",
            "holds files that the demo did not write.",
            where=str(output),
            hint="Name another folder with --output.",
        )
    shutil.rmtree(output, ignore_errors=True)
    output.mkdir(parents=True)
    (output / _MARK).touch()


def _make_scene(scene: Path, views: int, size: int) -> Path:
    click.echo(f"making a scene of {views} views with known poses, and turning each camera at random …")
    _biresnerf("make-scene", scene, "--views", views, "--size", size, "--noise", 0.15, "--seed", 1)
    return scene


def _biresnerf(*arguments: object) -> str:
    """The output of another command, run in its own process because it loads torch."""
    command = [sys.executable, "-m", "biresnerf.command_line", *map(str, arguments)]
    done = subprocess.run(command, capture_output=True, text=True)
    if done.returncode != 0:
        raise BiresnerfError(f"`biresnerf {arguments[0]}` failed: {done.stderr.strip()}")
    return done.stdout


def _send_and_fetch(url: str, scene: Path, target: Path, options: RefineOptions) -> None:
    with service_at(url, None) as client:
        with SendingView() as view:
            job = client.submit(scene, options, on_progress=view.sending)
        with JobProgressView() as progress:
            job = watch(client, job, progress)
        require_success(job)
        click.echo(f"fetched {len(fetch(client, job, target))} files")


def _print_outcome(result: Path, scene: Path, truth: Path | None) -> None:
    """Prints the pose errors before and after, or how far the poses moved if the truth is unknown."""
    report = Report.model_validate_json((result / "report.json").read_bytes())
    click.echo()
    for line in report.verdict.in_words() if report.verdict is not None else []:
        click.echo(line)
    if truth is not None:
        before, after = (_pose_error(path, truth) for path in (scene, result))
        click.echo("pose error (mean over the cameras)   before      after")
        click.echo(f"  rotation                        {before[0]:8.3f}°  {after[0]:8.3f}°")
        click.echo(f"  position, of camera distance    {before[1]:8.3f}%  {after[1]:8.3f}%")
    else:
        turned = [image.moved_deg for image in report.images]
        moved = [image.moved_units for image in report.images]
        click.echo("how far the poses moved              median     largest")
        click.echo(
            f"  rotation                        {statistics.median(turned):8.3f}°  {max(turned):8.3f}°"
        )
        click.echo(f"  position, in the scene's units  {statistics.median(moved):9.4g}  {max(moved):9.4g}")
    held_out = report.heldout
    if held_out is not None:
        click.echo(
            f"final render (unseen views: {held_out.count}): "
            f"PSNR {held_out.psnr:.2f} dB, SSIM {held_out.ssim:.3f}"
        )
    click.echo(f"\nfiles: {os.path.relpath(result)}")
    for name in ("report.html", "transforms.json", "colmap/sparse/0", "renders", "report.json"):
        if (result / name).exists():
            click.echo(f"  {name}")
    click.echo("the service's page, for sets of your own: run `biresnerf up` and open http://127.0.0.1:8000")


def _pose_error(poses: Path, truth: Path) -> tuple[float, float]:
    """Mean rotation error (deg) and centre error (% of the camera distance), after alignment."""
    values: dict[str, Any] = json.loads(_biresnerf("evaluate", poses, truth, "--json"))
    aligned = values["aligned"]
    return aligned["rotation_deg"]["mean"], aligned["centre_percent"]["mean"]
