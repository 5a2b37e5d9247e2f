"""`biresnerf download JOB --output OUT`: downloads the files of a result."""

from __future__ import annotations

import os
from pathlib import Path

import click

from biresnerf.commands.answers import json_option, show
from biresnerf.commands.jobs.follow_job import fetch
from biresnerf.commands.jobs.service_options import JOB, JobName, service_at, service_options


@click.command("download")
@click.argument("job", type=JOB)
@click.argument("names", metavar="[NAME]...", nargs=-1)
@click.option("--output", "-o", required=True, type=click.Path(path_type=Path), help="Folder for the files.")
@click.option("--replace", is_flag=True, help="Overwrite files that differ.")
@service_options
@json_option
def download_command(
    job: JobName,
    names: tuple[str, ...],
    output: Path,
    replace: bool,
    url: str | None,
    api_key: str | None,
    as_json: bool,
) -> None:
    """Download the result of JOB, or some of its files.

    NAME may hold * and ?; a folder stands for all files in it. Files that are there already are skipped, interrupted
    downloads are resumed. A running job has previews, a cancelled or failed one whatever it has written.
    """
    with service_at(url, api_key, job) as client:
        found = client.job(job.id)
        files = fetch(client, found, output, names=names or ("*",), replace=replace)
    document = {"job": found, "files": [str(path) for path in files]}
    show(document, f"{len(files)} files in {os.path.relpath(output)}", as_json=as_json)
