"""`biresnerf doctor`: what works on this machine, what is missing, and how to fix it."""

from __future__ import annotations

import pkgutil
from collections.abc import Iterator
from dataclasses import asdict

import click
from rich.console import Console

from biresnerf.commands import exit_codes
from biresnerf.commands.answers import json_option, print_json
from biresnerf.commands.machine.machine_checks import CHECKS, Check, Found
from biresnerf.errors import needs_extra

SERVICE_CHECKS = "service.commands.doctor_checks:CHECKS"


@click.command("doctor")
@click.option("--service", metavar="URL", help="Check a running service instead, as its clients see it.")
@click.option("--api-key", envvar="BIRESNERF_API_KEY", help="For --service. Prefer BIRESNERF_API_KEY.")
@json_option
def doctor_command(service: str | None, api_key: str | None, as_json: bool) -> int:
    """Check this installation: versions, kernels, GPU, COLMAP, PostgreSQL, disks, built pages.

    The first run compiles the kernels, which takes a minute or two. The exit status is 1 if something is broken;
    whatever is only missing is optional.

    With --service, check a running service from outside: address, TLS, readiness, clock, key, version, workers,
    room, and the upload and deletion of three pictures.
    """
    findings = _findings()
    if service is not None:
        with needs_extra("client"):
            from biresnerf.commands.machine.service_checks import service_checks
        findings = service_checks(service, api_key)
    found = []
    for result in findings:
        found.append(result)
        if not as_json:
            click.echo(f"{result.state:<8} {result.name:<12} {result.detail}")
            if result.hint:
                click.echo(f"{'':<22}{result.hint}")
    good = all(result.state != "broken" for result in found)
    if as_json:
        print_json({"good": good, "checks": [asdict(result) for result in found]})
    return exit_codes.DONE if good else exit_codes.FAILED


def _findings() -> Iterator[Found]:
    """The checks' results; on a terminal, with a line that says what is being checked."""
    console = Console(stderr=True)
    for check in all_checks():
        first = ": the first run compiles them, for a minute or two" if check.__name__ == "kernels" else ""
        with console.status(f"checking {check.__name__.strip('<>').replace('_', ' ')}{first}"):
            found = check()
        yield found


def all_checks() -> Iterator[Check]:
    """The library's checks, then the service's where it is installed."""
    yield from CHECKS
    try:
        yield from pkgutil.resolve_name(SERVICE_CHECKS)
    except ModuleNotFoundError as error:
        detail = f"is not installed ({error.name})"
        yield lambda: Found("service", "missing", detail, "pip install 'biresnerf[service]'")
