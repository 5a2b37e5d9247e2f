"""After a command has queued a job: prints its address, waits for it, fetches its files."""

from __future__ import annotations

import os
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from biresnerf.commands import exit_codes
from biresnerf.commands.answers import print_json
from biresnerf.commands.jobs.job_progress import BytesView, JobProgressView, watch
from biresnerf.commands.jobs.service_options import page_of

if TYPE_CHECKING:
    from biresnerf.client import Client
    from biresnerf.wire.jobs import JobView


timeout_option = click.option(
    "--timeout",
    "timeout_s",
    type=click.FloatRange(0, min_open=True),
    metavar="SECONDS",
    help="Stop waiting after this time; the job continues, and the exit status is 7.",
)


def follow_options(command: Callable[..., Any]) -> Callable[..., Any]:
    """Give a click command `--wait`, `--timeout` and `--output`."""
    wait = click.option("--wait", is_flag=True, help="Show progress until the job is over.")
    output = click.option(
        "--output", "-o", type=click.Path(path_type=Path), help="Download the result here; implies --wait."
    )
    return wait(timeout_option(output(command)))


def see_through(
    client: Client, job: JobView, *, wait: bool, timeout_s: float | None, output: Path | None, as_json: bool
) -> None:
    """Print the address of the job's page, then wait for it and fetch its files if asked to. Raises `JobFailed`."""
    if not as_json:
        click.echo(page_of(client, job.id))
    if wait or timeout_s is not None or output is not None:
        job = waited_for(client, job, timeout_s, as_json=as_json)
        if as_json:
            print_json(job)
        require_success(job)
        if output is not None:
            count = len(fetch(client, job, output))
            click.echo(f"{count} files in {os.path.relpath(output)}", err=as_json)
    elif as_json:
        print_json(job)


def waited_for(client: Client, job: JobView, timeout_s: float | None, *, as_json: bool) -> JobView:
    """The job once it is over; shows its progress on standard error.

    Ctrl-C, ``timeout_s`` and a service that cannot be reached end the waiting, not the job: it prints how to resume.
    """
    from biresnerf.client import JobNotOver, ServiceError

    try:
        with JobProgressView() as view:
            return watch(client, job, view, timeout_s)
    except KeyboardInterrupt:
        _print_how_to_wait_again(client, job)
        raise click.exceptions.Exit(exit_codes.SIGINT) from None
    except JobNotOver:
        if as_json:
            print_json(client.job(job.id))
        _print_how_to_wait_again(client, job)
        raise click.exceptions.Exit(exit_codes.NOT_OVER) from None
    except ServiceError as error:
        if error.retryable:
            _print_how_to_wait_again(client, job)
        raise


def _print_how_to_wait_again(client: Client, job: JobView) -> None:
    address = page_of(client, job.id)
    click.echo(f"The job continues. To wait again: biresnerf wait '{address}'", err=True)
    click.echo(f"To stop it: biresnerf cancel '{address}'", err=True)


def require_success(job: JobView) -> None:
    """Raises `JobFailed` unless the job has succeeded."""
    from biresnerf.client import JobFailed

    if job.state != "succeeded":
        raise JobFailed(job)


def fetch(client: Client, job: JobView, output: Path, **how: Any) -> list[Path]:
    """Downloads the job's files to ``output``, with a progress bar; a later call resumes an interrupted one."""
    with BytesView("downloading") as view:
        return client.download_all(job.id, output, on_bytes=view.more, **how)
