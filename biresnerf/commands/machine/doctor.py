"""`biresnerf doctor`: what works on this machine, what is missing, and how to fix it."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import asdict
from importlib.metadata import entry_points

import click

from biresnerf.commands import exit_codes
from biresnerf.commands.answers import json_option, print_json
from biresnerf.commands.machine.finding import Check, Found
from biresnerf.commands.machine.machine_checks import CHECKS

# Other parts of the installation name their checks here, as they name their commands.
GROUP = "biresnerf.checks"


@click.command("doctor")
@json_option
def doctor_command(as_json: bool) -> int:
    """Check this installation: versions, kernels, GPU, COLMAP, PostgreSQL, disks, the built pages.

    The first run compiles the kernels, which takes half a minute. Exit status 1 where something is broken; what is
    merely missing is optional.
    """
    found = []
    for check in all_checks():
        one = check()
        found.append(one)
        if not as_json:
            click.echo(f"{one.state:<8} {one.name:<12} {one.detail}")
            if one.hint:
                click.echo(f"{'':<22}{one.hint}")
    good = all(one.state != "broken" for one in found)
    if as_json:
        print_json({"good": good, "checks": [asdict(one) for one in found]})
    return exit_codes.DONE if good else exit_codes.FAILED


def all_checks() -> Iterator[Check]:
    """Those of the library, then those of whatever else is installed."""
    yield from CHECKS
    for point in entry_points(group=GROUP):
        try:
            checks = point.load()
        except ModuleNotFoundError as error:
            missing = Found(
                point.name,
                "missing",
                f"is not installed ({error.name})",
                f"pip install 'biresnerf[{point.name}]'",
            )
            yield lambda missing=missing: missing  # type: ignore[misc]
        else:
            yield from checks
