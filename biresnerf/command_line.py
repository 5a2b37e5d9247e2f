"""The command `biresnerf`: finds its commands by their entry points and turns errors into exit codes.

A command's module is imported only when it is used, so that `biresnerf submit` loads no torch.
"""

from __future__ import annotations

import sys
from importlib.metadata import EntryPoint, entry_points

import click

from biresnerf.commands import exit_codes
from biresnerf.commands.completion import NAME
from biresnerf.errors import BiresnerfError, InputError

GROUP = "biresnerf.commands"
# What brings a package that is not installed; all others come with the service.
_EXTRAS = {
    "httpx": "client",
    "anyio": "client",
    "scipy": "compare",
    "matplotlib": "compare",
    "pycolmap": "colmap",
}


class _FoundCommands(click.Group):
    """Commands by entry point."""

    def list_commands(self, ctx: click.Context) -> list[str]:
        return sorted(point.name for point in entry_points(group=GROUP))

    def get_command(self, ctx: click.Context, cmd_name: str) -> click.Command | None:
        for point in entry_points(group=GROUP, name=cmd_name):
            return _loaded(point)
        return None


def _loaded(point: EntryPoint) -> click.Command:
    try:
        command = point.load()
    except ModuleNotFoundError as error:
        # The extra that the command belongs to is not installed.
        missing = error.name

        @click.command(
            point.name, context_settings={"ignore_unknown_options": True, "allow_extra_args": True}
        )
        def unavailable() -> None:
            raise _missing(missing, point.name)

        unavailable.help = f"(not installed: {missing})"
        return unavailable
    if not isinstance(command, click.Command):
        raise TypeError(f"entry point {point.name} is no click command")
    return command


def _missing(package: str | None, command: str) -> InputError:
    extra = _EXTRAS.get(package or "", "service")
    return InputError(
        "extra_missing",
        f"needs the package {package}, which is not installed.",
        where=f"biresnerf {command}",
        mend=f"Install it with: pip install 'biresnerf[{extra}]'",
    )


@click.command(cls=_FoundCommands, context_settings={"help_option_names": ["-h", "--help"]})
@click.version_option(package_name="biresnerf")
def cli() -> None:
    """Refine the camera poses of an image set, here or through a service."""


def main() -> None:
    """Entry point; `exit_codes` says what the exit status means."""
    try:
        status = cli.main(prog_name=NAME, standalone_mode=False)
        sys.exit(status if isinstance(status, int) else exit_codes.DONE)
    except click.ClickException as error:
        error.show()
        sys.exit(error.exit_code)
    except (click.Abort, KeyboardInterrupt):
        click.echo("stopped", err=True)
        sys.exit(exit_codes.SIGINT)
    except InputError as error:
        click.echo(f"error: {error}", err=True)
        sys.exit(exit_codes.INPUT)
    except (BiresnerfError, OSError) as error:
        click.echo(f"error: {error}", err=True)
        sys.exit(exit_codes.FAILED)


if __name__ == "__main__":
    main()
