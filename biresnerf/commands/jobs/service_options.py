"""Shared by all commands that talk to a service: address, API key, job arguments, exit codes."""

from __future__ import annotations

import re
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import TYPE_CHECKING, Any, NamedTuple

import click

from biresnerf.commands import exit_codes
from biresnerf.commands.answers import with_code
from biresnerf.commands.exit_codes import CommandFailed
from biresnerf.errors import needs_extra

if TYPE_CHECKING:
    from biresnerf.client import Client, ServiceError

DEFAULT_URL = "http://127.0.0.1:8000"
PAGE = "/#/jobs/"


class JobName(NamedTuple):
    """A job on a command line: its id, and its service's address if the job was named by its address."""

    id: str
    url: str | None = None


class _JobParameter(click.ParamType):
    name = "job"

    def convert(self, value: Any, param: click.Parameter | None, ctx: click.Context | None) -> JobName:
        if isinstance(value, JobName):
            return value
        url, path, ident = re.sub("/#/jobs/|/v1/jobs/", PAGE, value).rpartition(PAGE)
        if (not path and "/" in value) or not ident.strip("/"):
            self.fail(f"{value!r} is neither a job's id nor its address.", param, ctx)
        return JobName(ident.strip("/"), url or None)


JOB = _JobParameter()


def page_of(client: Client, job_id: str) -> str:
    """The address of a job's page, which commands take as well."""
    return f"{client.url}{PAGE}{job_id}"


def service_options(command: Callable[..., Any]) -> Callable[..., Any]:
    """Give a click command `--url` and `--api-key`, as ``url`` and ``api_key``."""
    url = click.option(
        "--url",
        envvar="BIRESNERF_URL",
        help=f"Address of the service. Default: BIRESNERF_URL, else {DEFAULT_URL}.",
    )
    key = click.option(
        "--api-key",
        envvar="BIRESNERF_API_KEY",
        help="Prefer BIRESNERF_API_KEY: other users can see command lines.",
    )
    return url(key(command))


@contextmanager
def service_at(url: str | None, api_key: str | None, job: JobName | None = None) -> Iterator[Client]:
    """A client of the service in the job's address, at `--url`, or on this machine. Errors become exit codes."""
    with needs_extra("client"):
        from biresnerf.client import Client, JobFailed, ServiceError
    try:
        chosen = (job.url if job is not None else None) or url or DEFAULT_URL
        with Client(chosen, api_key=api_key, on_pause=_print_pause) as client:
            yield client
    except ServiceError as error:
        raise CommandFailed(with_code(error), exit_code_of(error)) from None
    except JobFailed as error:
        raise CommandFailed(str(error), exit_codes.JOB) from None


def _print_pause(error: ServiceError, seconds: float) -> None:
    if seconds >= 2.0:
        click.echo(f"trying again in {seconds:.0f} s: {error.detail}", err=True)


def exit_code_of(error: ServiceError) -> int:
    """The exit status for an error of a service."""
    if error.code == "unexpected_answer" and error.status < 500 and not error.retryable:
        return exit_codes.INPUT  # another program answers there: the address is wrong
    if error.status in {404, 410}:
        return exit_codes.NOT_FOUND
    if error.status in {401, 403}:
        return exit_codes.KEY
    if error.users_fault:
        return exit_codes.INPUT
    if error.retryable:
        return exit_codes.AWAY
    return exit_codes.FAILED
