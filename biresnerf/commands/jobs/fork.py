"""`biresnerf fork JOB`: the same images with other options, reusing what stays the same."""

from __future__ import annotations

from typing import Any, get_args

import click

from biresnerf.client.job_calls import with_name
from biresnerf.commands.answers import json_option
from biresnerf.commands.jobs.follow_job import Follow, follow_options, see_through
from biresnerf.commands.jobs.service_options import JOB, JobName, Service, service_at, service_options
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
    follow: Follow,
    labels: dict[str, str],
    service: Service,
    as_json: bool,
) -> None:
    """Queue JOB again with other options, reusing the work that they do not change."""
    from biresnerf.options.refine_options import parse_options

    options = parse_options(settings)
    with service_at(service, job) as client:
        if called := client.job(job.id).labels.get("name"):
            labels = with_name(labels, called)
        made = client.fork(job.id, options, from_stage=from_stage, labels=labels)
        see_through(client, made, follow, as_json=as_json)
