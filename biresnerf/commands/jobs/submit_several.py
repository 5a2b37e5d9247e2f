"""`biresnerf submit A B C`: several sets in one call, as a batch of jobs."""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any
from urllib.parse import urlsplit

import click

from biresnerf.commands import exit_codes
from biresnerf.commands.answers import print_json, with_code
from biresnerf.commands.exit_codes import CommandFailed
from biresnerf.commands.jobs.follow_job import fetch, waited_for
from biresnerf.commands.jobs.service_options import exit_code_of, page_of
from biresnerf.errors import InputError
from biresnerf.wire.batches import BATCH_MOST

if TYPE_CHECKING:
    from biresnerf.client import Client
    from biresnerf.options.refine_options import RefineOptions
    from biresnerf.wire.batches import BatchView
    from biresnerf.wire.datasets import DatasetView
    from biresnerf.wire.jobs import JobView

ONE_SET_ALONE = ("resume", "fixed_from")


def require_several(paths: Sequence[Path | str], deliver: str | None, how: Mapping[str, Any]) -> None:
    """Raises a usage error for more sets than a batch takes, and for options of one set alone."""
    for name in ONE_SET_ALONE:
        if how.get(name) is not None:
            raise click.UsageError(f"--{name.replace('_', '-')} is for one set alone.")
    if deliver is not None and deliver.endswith(".zip"):
        raise click.UsageError("--deliver names one zip; for several sets, name a prefix.")
    if len(paths) > BATCH_MOST:
        raise click.UsageError(f"At most {BATCH_MOST} sets are submitted in one call.")


def name_of(path: Path | str) -> str:
    """What a set is called: its folder, or the end of its address."""
    if isinstance(path, Path):
        folder = path.resolve()
        return (folder.parent if folder.is_file() else folder).name or "scene"
    return urlsplit(path).path.rstrip("/").rpartition("/")[2] or urlsplit(path).netloc


def named(paths: Sequence[Path | str]) -> dict[str, Path | str]:
    """The sets by names that are unique."""
    found: dict[str, Path | str] = {}
    for path in paths:
        name, count = name_of(path), 1
        while name in found:
            count += 1
            name = f"{name_of(path)}-{count}"
        found[name] = path
    return found


def submit_several(
    client: Client,
    paths: Sequence[Path | str],
    options: RefineOptions,
    send: Callable[[str, Path | str], DatasetView],
    *,
    deliver: str | None,
    wait: bool,
    timeout_s: float | None,
    output: Path | None,
    as_json: bool,
    **how: Any,
) -> None:
    """Sends one set after the other, queues a job for each that is good, and prints a line for each.

    Raises `CommandFailed` at the end where a set was refused, or a job that was waited for did not succeed.
    """
    from biresnerf.client import ServiceError, bucket_target

    sets = named(paths)
    targets = {name: bucket_target(f"{deliver.rstrip('/')}/{name}") for name in sets} if deliver else {}
    ready: dict[str, DatasetView] = {}
    over: list[JobView] = []
    for name, path in sets.items():
        try:
            ready[name] = send(name, path)
        except (InputError, ServiceError) as error:
            if isinstance(error, ServiceError) and exit_code_of(error) != exit_codes.INPUT:
                raise
            click.echo(f"{path}: {with_code(error)}", err=True)
    if ready:
        batch = _queued(client, ready, options, how, targets)
        jobs = dict(zip(ready, batch.jobs, strict=True))
        if not as_json:
            for name, job in jobs.items():
                click.echo(f"{page_of(client, job.id)}  {sets[name]}")
        try:
            if wait or timeout_s is not None or output is not None:
                ids = {name: job.id for name, job in jobs.items()}
                over = _seen_through(client, ids, timeout_s, output)
        finally:
            if as_json:
                print_json(client.batch(batch.id))
    if refused := len(sets) - len(ready):
        raise CommandFailed(f"{refused} of {len(sets)} sets cannot be used.", exit_codes.INPUT)
    if failed := sum(job.state != "succeeded" for job in over):
        raise CommandFailed(f"{failed} of {len(over)} jobs did not succeed.", exit_codes.JOB)


def _queued(
    client: Client,
    ready: Mapping[str, DatasetView],
    options: RefineOptions,
    how: dict[str, Any],
    targets: Mapping[str, Any],
) -> BatchView:
    from biresnerf.client.job_calls import with_name
    from biresnerf.wire.jobs import NewJob

    labels = how.pop("labels")
    made = [
        NewJob(
            dataset_id=dataset.id,
            options=options,
            labels=with_name(labels, name),
            **how,
            **({"deliver": targets[name]} if targets else {}),
        )
        for name, dataset in ready.items()
    ]
    return client.create_batch(made)


def _seen_through(
    client: Client, jobs: Mapping[str, str], timeout_s: float | None, output: Path | None
) -> list[JobView]:
    """The jobs once they are over; those that succeeded are fetched, each to a folder of its own."""
    deadline, over = time.monotonic() + (timeout_s or 0.0), []
    for name, job_id in jobs.items():
        click.echo(f"{name}:", err=True)
        left_s = None if timeout_s is None else max(0.0, deadline - time.monotonic())
        job = waited_for(client, client.job(job_id), left_s, as_json=False)
        told = job.verdict or "" if job.error is None else f"{job.error.detail} [{job.error.code}]"
        click.echo(f"{name}: {job.state}" + (f", {told}" if told else ""), err=True)
        if output is not None and job.state == "succeeded":
            fetch(client, job, output / name)
        over.append(job)
    return over
