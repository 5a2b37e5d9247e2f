"""`biresnerf fork JOB`: the same images with other options, reusing what stays the same."""

from __future__ import annotations

from pathlib import Path
from typing import Any, get_args

import click

from biresnerf.client.job_calls import with_name
from biresnerf.commands.answers import json_option
from biresnerf.commands.empty_folder import require_empty
from biresnerf.commands.jobs.follow_job import follow_options, see_through
from biresnerf.commands.jobs.service_options import JOB, JobName, service_at, service_options
from biresnerf.commands.jobs.submit import label_option
from biresnerf.commands.settings_option import settings_option
from biresnerf.wire.jobs import WantedStage


@click.command("fork")
@click.argument("job", type=JOB)
@settings_option
@click.option(
    "--from-stage", type=click.Choice(get_args(WantedStage)), default="auto", show_default=True,
    help="The stage to reuse; auto: the latest that the options allow.",
)  # fmt: skip
@follow_options
@label_option
@service_options
@json_option
def fork_command(
    job: JobName,
    settings: dict[str, Any],
    from_stage: WantedStage,
    wait: bool,
    timeout_s: float | None,
    output: Path | None,
    labels: dict[str, str],
    url: str | None,
    api_key: str | None,
    as_json: bool,
) -> None:
    """Queue JOB again with other options, reusing the work that they do not change."""
    from biresnerf.options.refine_options import parse_options

    if output is not None:
        require_empty(output)
    options = parse_options(settings)
    with service_at(url, api_key, job) as client:
        if called := client.job(job.id).labels.get("name"):
            labels = with_name(labels, called)
        made = client.fork(job.id, options, from_stage=from_stage, labels=labels)
        see_through(client, made, wait=wait, timeout_s=timeout_s, output=output, as_json=as_json)
