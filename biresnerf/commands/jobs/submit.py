"""`biresnerf submit PATH...`: sends sets to a service, or says where they are, and fetches the results."""

from __future__ import annotations

import shlex
import sys
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from datetime import datetime
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from biresnerf.commands import exit_codes
from biresnerf.commands.answers import json_option
from biresnerf.commands.empty_folder import require_empty
from biresnerf.commands.jobs.follow_job import follow_options, see_through
from biresnerf.commands.jobs.job_progress import SendingView
from biresnerf.commands.jobs.service_options import service_at, service_options
from biresnerf.commands.jobs.submit_several import name_of, require_several, submit_several
from biresnerf.commands.settings_option import budget_option, settings_option
from biresnerf.options.presets import PRESET_IF_LEFT_OUT
from biresnerf.wire.jobs import DEADLINE_MOST_S

if TYPE_CHECKING:
    from biresnerf.client import Client, FileAddress, Sending
    from biresnerf.options.refine_options import RefineOptions
    from biresnerf.wire.datasets import DatasetView
    from biresnerf.wire.jobs import JobView


def _labels(_context: click.Context, _parameter: click.Parameter, texts: tuple[str, ...]) -> dict[str, str]:
    labels = {}
    for text in texts:
        name, separator, value = text.partition("=")
        if not separator or not name or not value:
            raise click.BadParameter(f"{text!r} is not NAME=VALUE")
        labels[name] = value
    return labels


def _time(_context: click.Context, _parameter: click.Parameter, text: str | None) -> datetime | None:
    try:
        return None if text is None else datetime.fromisoformat(text).astimezone()
    except ValueError:
        raise click.BadParameter(f"{text!r} is not a time such as 2026-01-31T18:30") from None


label_option = click.option(
    "--label",
    "labels",
    multiple=True,
    metavar="NAME=VALUE",
    callback=_labels,
    help="A label to find the job by; may be repeated.",
)


class _SetParameter(click.ParamType):
    """A local path, or an unchanged address."""

    name = "path"

    def convert(self, value: Any, param: click.Parameter | None, ctx: click.Context | None) -> Path | str:
        return value if "://" in str(value) else Path(value)


@click.command("submit")
@click.argument("paths", type=_SetParameter(), nargs=-1, required=True, metavar="PATH...")
@click.option("--preset", help=f"fast, balanced, quality or paper. Default: {PRESET_IF_LEFT_OUT}.")
@budget_option
@settings_option
@follow_options
@click.option(
    "--priority", type=click.Choice(["low", "normal", "high"]), default="normal", show_default=True,
    help="Jobs of higher priority run first; your tenant may have a lower limit.",
)  # fmt: skip
@click.option(
    "--expires-in-queue",
    "expires_in_queue_s",
    type=click.IntRange(1, DEADLINE_MOST_S),
    metavar="SECONDS",
    help="End the job as expired if it has not started after this time.",
)
@click.option(
    "--deadline",
    "deadline_at",
    callback=_time,
    metavar="TIME",
    help="Stop the job then, with its best poses so far; as expired if it has not started. Local time, unless it says "
    "otherwise.",
)
@click.option(
    "--part-photos",
    type=click.IntRange(20, 10_000),
    metavar="PHOTOS",
    help="Split the job into parts of about so many photos, for several workers. Default: as the service has set.",
)
@label_option
@click.option(
    "--fixed-from",
    metavar="JOB",
    help="A job with a result of some of the photos: they keep its poses and lenses, and the others join its frame.",
)
@click.option(
    "--deliver",
    metavar="S3",
    help="s3://bucket/prefix, or .../name.zip: the service sends the files there as a zip once the job is over.",
)
@click.option("--resume", metavar="DATASET", help="Resume an interrupted submission with its dataset.")
@service_options
@json_option
def submit_command(
    paths: tuple[Path | str, ...],
    preset: str | None,
    time_budget_s: float | None,
    settings: dict[str, Any],
    output: Path | None,
    url: str | None,
    api_key: str | None,
    deliver: str | None,
    **how: Any,
) -> None:
    """Submit PATH to a service as a job, or several as a batch of jobs.

    PATH is a folder of images, or a file with poses in one. Sends only files that the service lacks, and prints the
    job's address. Ctrl-C while waiting leaves the job running.

    Of several sets, those that the service refuses are named and left out. A line for each other has the address of its
    job and the PATH; --output gets a folder for each. The exit status is 2 if a set was refused, else 3 if a job that
    was waited for did not succeed.

    PATH may also be the address of an archive (https://...), or a folder or archive in a bucket (s3://bucket/prefix).
    The service fetches these itself. Addresses of a bucket are signed here: your credentials stay on this machine.
    """
    from biresnerf.options.refine_options import parse_options

    named = {"preset": preset, "time_budget_s": time_budget_s}
    options = parse_options({**settings, **{key: value for key, value in named.items() if value}})
    if output is not None:
        require_empty(output)
    follow = {"output": output, **{name: how.pop(name) for name in ("wait", "timeout_s", "as_json")}}
    how = {key: value for key, value in how.items() if value is not None}
    if len(paths) > 1:
        require_several(paths, deliver, how)
    with service_at(url, api_key) as client:
        if len(paths) > 1:
            submit_several(
                client, paths, options, partial(_sent, client, options), deliver=deliver, **follow, **how
            )
            return
        if deliver is not None:
            from biresnerf.client import bucket_target

            how["deliver"] = bucket_target(deliver)
        see_through(client, _submitted(client, paths[0], options, how), **follow)


def _submitted(client: Client, path: Path | str, options: RefineOptions, how: dict[str, Any]) -> JobView:
    """Submits a folder or what is at an address, with progress on standard error.

    After Ctrl-C it prints the command that resumes.
    """
    with _sending(again_as_it_is="resume" in how) as note:
        source = () if "resume" in how and isinstance(path, str) else _source(path)
        return client.submit(source, options, name=name_of(path), on_progress=note, **how)


def _sent(client: Client, options: RefineOptions, name: str, path: Path | str) -> DatasetView:
    """One of several sets, checked."""
    click.echo(f"{name}:", err=True)
    with _sending(again_as_it_is=True) as note:
        return client.send(_source(path), options, name=name, on_progress=note)


@contextmanager
def _sending(*, again_as_it_is: bool) -> Iterator[Callable[[Sending], None]]:
    last: Sending | None = None

    def note(sending: Sending) -> None:
        nonlocal last
        last = sending
        view.sending(sending)

    with SendingView() as view:
        try:
            yield note
        except KeyboardInterrupt:
            dataset = None if last is None else last.dataset_id
            if dataset is None and not again_as_it_is:
                click.echo("Stopped before anything was sent.", err=True)
            else:
                again = ["biresnerf", *sys.argv[1:], *(() if again_as_it_is else ("--resume", str(dataset)))]
                click.echo("Stopped; the service keeps what it has received. To resume:", err=True)
                click.echo(f"  {shlex.join(again)}", err=True)
            raise click.exceptions.Exit(exit_codes.SIGINT) from None


def _source(path: Path | str) -> Path | Sequence[FileAddress]:
    """What the client submits: a local path unchanged, or the addresses of the files at an address."""
    from biresnerf.client import FileAddress, bucket_files

    if isinstance(path, Path):
        return path
    return bucket_files(path) if path.startswith("s3://") else (FileAddress(url=path),)
