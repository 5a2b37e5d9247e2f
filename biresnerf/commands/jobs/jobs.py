"""Commands about jobs of a service: `status`, `list`, `wait`, `logs`, `cancel`, `delete`."""

from __future__ import annotations

import time
from datetime import UTC, datetime
from typing import TYPE_CHECKING, Any, get_args

import click

from biresnerf.commands import exit_codes
from biresnerf.commands.answers import json_option, print_json, show, table
from biresnerf.commands.jobs.follow_job import require_success, timeout_option, waited_for
from biresnerf.commands.jobs.job_progress import left_of, numbers_of, stage_of
from biresnerf.commands.jobs.service_options import JOB, JobName, page_of, service_at, service_options
from biresnerf.wire.jobs import JobState, JobView

if TYPE_CHECKING:
    from biresnerf.client import Client

_LOG_EVERY_S = 1.0


@click.command("status")
@click.argument("job", type=JOB)
@service_options
@json_option
def status_command(job: JobName, url: str | None, api_key: str | None, as_json: bool) -> None:
    """Show the state of JOB.

    JOB is an id, or an address as `submit` prints it.
    """
    with service_at(url, api_key, job) as client:
        found = client.job(job.id)
    show(found, described(found), as_json=as_json)


def described(job: JobView) -> str:
    """A job in lines of text."""
    lines = [f"{job.id}  {stage_of(job)}"]
    if job.state == "running":
        lines.append(f"  {100 * job.progress.fraction:.0f} %  {numbers_of(job)}  left {left_of(job)}")
    if job.cancel_requested and not job.final:
        lines.append("  cancellation requested")
    if job.attempt > 1:
        lines.append(f"  attempt {job.attempt}")
    if job.partial:
        lines.append("  partial result: the best poses when it was stopped")
    if job.verdict is not None:
        lines.append(f"  verdict: {job.verdict}")
    if job.error is not None:
        error = job.error
        lines.append("  " + " ".join(part for part in (f"{error.code}:", error.detail, error.hint) if part))
    if job.labels:
        lines.append("  " + "  ".join(f"{name}={value}" for name, value in job.labels.items()))
    if job.expires_at is not None:
        lines.append(f"  files are kept until {job.expires_at:%Y-%m-%d %H:%M %Z}")
    return "\n".join(lines)


@click.command("list")
@click.option("--state", type=click.Choice(get_args(JobState)), help="Only those in this state.")
@click.option("--label", metavar="NAME=VALUE", help="Only those with this label.")
@click.option("--limit", type=click.IntRange(1), default=20, show_default=True, help="At most this many.")
@service_options
@json_option
def list_command(
    state: JobState | None, label: str | None, limit: int, url: str | None, api_key: str | None, as_json: bool
) -> None:
    """List jobs, newest first."""
    wanted = None
    if label is not None:
        name, separator, value = label.partition("=")
        if not separator:
            raise click.BadParameter(f"{label!r} is not NAME=VALUE", param_hint="--label")
        wanted = (name, value)
    with service_at(url, api_key) as client:
        found = client.jobs(state=state, label=wanted, limit=limit)
    text = "no jobs"
    if found:
        text = table([("JOB", "STATE", "DONE", "SUBMITTED", "OUTCOME", "LABELS"), *map(_row, found)])
        if len(found) == limit:
            text += f"\nThe newest {limit}; --limit shows more."
    show({"items": found}, text, as_json=as_json)


def _row(job: JobView) -> tuple[str, ...]:
    return (
        job.id,
        stage_of(job),
        f"{100 * job.progress.fraction:.0f} %",
        _age(job),
        job.verdict or (job.error.code if job.error else ""),
        " ".join(f"{name}={value}" for name, value in job.labels.items()),
    )


def _age(job: JobView) -> str:
    """How long ago it was submitted, in the largest unit."""
    seconds = max(0, int((datetime.now(UTC) - job.created_at).total_seconds()))
    for unit, length in (("d", 86400), ("h", 3600), ("min", 60)):
        if seconds >= length:
            return f"{seconds // length} {unit} ago"
    return f"{seconds} s ago"


@click.command("wait")
@click.argument("job", type=JOB)
@timeout_option
@service_options
@json_option
def wait_command(
    job: JobName, timeout_s: float | None, url: str | None, api_key: str | None, as_json: bool
) -> None:
    """Show the progress of JOB until it is over.

    The exit status is 0 if it succeeded and 3 if not. Ctrl-C stops waiting; the job continues.
    """
    with service_at(url, api_key, job) as client:
        over = waited_for(client, client.job(job.id), timeout_s, as_json=as_json)
        if as_json:
            print_json(over)
        require_success(over)
        if not as_json:
            click.echo(described(over))


@click.command("logs")
@click.argument("job", type=JOB)
@click.option("--follow", "-f", is_flag=True, help="Continue until the job is over.")
@click.option("--after", type=click.IntRange(0), default=0, help="Only lines after this number.")
@service_options
@json_option
def logs_command(
    job: JobName, follow: bool, after: int, url: str | None, api_key: str | None, as_json: bool
) -> None:
    """Print the log of JOB."""
    if follow and as_json:
        raise click.UsageError("--follow and --json exclude each other; see `biresnerf wait --json`.")
    lines = []
    with service_at(url, api_key, job) as client:
        while True:
            # The state first: lines written between the two requests are not missed.
            over = client.job(job.id).final
            while page := client.log(job.id, after=after):
                after = page[-1].n
                lines += page
                if not as_json:
                    click.echo("\n".join(line.text for line in page))
            if over or not follow:
                break
            _sleep_or_leave(client, job)
    if as_json:
        print_json({"items": lines})


def _sleep_or_leave(client: Client, job: JobName) -> None:
    try:
        time.sleep(_LOG_EVERY_S)
    except KeyboardInterrupt:
        click.echo(f"The job continues: biresnerf wait '{page_of(client, job.id)}'", err=True)
        raise click.exceptions.Exit(exit_codes.SIGINT) from None


@click.command("cancel")
@click.argument("job", type=JOB)
@click.option("--keep-partial", is_flag=True, help="Keep the best poses so far as the result.")
@click.option("--wait", is_flag=True, help="Wait until it has ended.")
@timeout_option
@service_options
@json_option
def cancel_command(
    job: JobName,
    keep_partial: bool,
    wait: bool,
    timeout_s: float | None,
    url: str | None,
    api_key: str | None,
    as_json: bool,
) -> None:
    """Stop JOB. Does nothing if it is over already."""
    with service_at(url, api_key, job) as client:
        found = client.cancel(job.id, keep_partial=keep_partial)
        if (wait or timeout_s is not None) and not found.final:
            found = waited_for(client, found, timeout_s, as_json=as_json)
    text = described(found) if found.final else f"cancellation of {found.id} requested"
    show(found, text, as_json=as_json)


@click.command("delete")
@click.argument("jobs", metavar="JOB...", nargs=-1, required=True, type=JOB)
@service_options
@json_option
def delete_command(jobs: tuple[JobName, ...], url: str | None, api_key: str | None, as_json: bool) -> None:
    """Delete jobs that are over, with their results and exports."""
    deleted: list[Any] = []
    for job in jobs:
        with service_at(url, api_key, job) as client:
            client.delete_job(job.id)
        deleted.append(job.id)
        if not as_json:
            click.echo(f"deleted {job.id}")
    if as_json:
        print_json({"deleted": deleted})
