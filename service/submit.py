"""`biresnerf submit`: a scene from this machine through a service and back."""

from __future__ import annotations

import os
from pathlib import Path
from typing import NamedTuple

import click
from rich.console import Console

from biresnerf.config import RefineOptions
from biresnerf.errors import BiresnerfError, InputError
from biresnerf.wire.datasets import DatasetView
from biresnerf.wire.jobs import JobView, PriorityName
from biresnerf.wire.safe_paths import checked_path
from service.client import Client, ServiceError
from service.pack import Scene, look_at
from service.progress_view import progress_view, watch
from service.sending import LocalFile, send_missing


def submit_scene(
    client: Client, scene: Scene, name: str, options: RefineOptions, priority: PriorityName = "normal"
) -> JobView:
    """Sends what the service lacks of the scene, has it checked, queues a job. Leaves nothing behind on failure.

    Lost connections and restarts of the service are waited for, and sending goes on where it broke off.
    """
    files = [LocalFile.at(name, path) for name, path in scene.files]
    dataset = client.create_dataset(name[:200] or "scene", [file.entry for file in files])
    try:
        sent = send_missing(client, dataset, files)
        if sent < len(files):
            click.echo(f"{len(files) - sent} of the files were there already", err=True)
        client.finalize(dataset)
        return client.submit(dataset.id, options, priority=priority)
    except BaseException:
        _forget(client, dataset)
        raise


def _forget(client: Client, dataset: DatasetView) -> None:
    try:
        client.delete_dataset(dataset)
    except ServiceError as error:
        click.echo(f"The dataset {dataset.id} stayed on the service: {error}", err=True)


def require_empty(folder: Path) -> None:
    """Raises `InputError` where downloads would mix with other files."""
    if folder.exists() and (not folder.is_dir() or any(folder.iterdir())):
        raise InputError(
            "output_not_empty",
            "is not an empty folder.",
            where=str(folder),
            mend="Name a new folder for the results.",
        )


def download_all(client: Client, job: JobView, output: Path) -> list[Path]:
    """All files of the result below ``output``; returns their paths. Raises `ServiceError`."""
    written = []
    for artifact in client.artifacts(job):
        # The name comes from a server that we need not trust.
        target = output / checked_path(artifact.name)
        client.download(artifact, target)
        written.append(target)
    return written


class Where(NamedTuple):
    """A service, and the key that it wants."""

    url: str
    api_key: str | None = None


def run_submit(
    path: Path,
    options: RefineOptions,
    service: Where,
    *,
    wait: bool,
    output: Path | None,
    priority: PriorityName = "normal",
) -> None:
    """The command's work; raises `InputError` (the user's to mend) or another `BiresnerfError`."""
    if output is not None:
        require_empty(output)
    scene = look_at(path)
    try:
        with Client(service.url, api_key=service.api_key) as client:
            click.echo(f"sending {len(scene.files)} files, {scene.total_bytes / 1e6:.1f} MB", err=True)
            job = submit_scene(client, scene, path.resolve().name, options, priority)
            click.echo(f"{client.url}{job.links.self}")
            if not wait and output is None:
                return
            with progress_view(Console(stderr=True)) as view:
                job = watch(client, job, view)
            _finish(client, job, output)
    except ServiceError as error:
        if error.users_fault:
            raise InputError(error.code, error.what, where=error.where, mend=error.mend) from None
        raise


def _finish(client: Client, job: JobView, output: Path | None) -> None:
    if job.state == "succeeded":
        if output is not None:
            files = download_all(client, job, output)
            click.echo(f"{len(files)} files in {os.path.relpath(output)}")
        return
    error = job.error
    if error is None:
        raise BiresnerfError(f"The job {job.id} was {job.state}.")
    if error.mend:
        raise InputError(error.code, error.detail, where=error.where, mend=error.mend)
    raise BiresnerfError(f"The job {job.id} failed ({error.code}): {error.detail}")
