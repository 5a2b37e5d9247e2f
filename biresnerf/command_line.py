"""The command `biresnerf`: finds its commands by their entry points and turns errors into exit codes.

A command's module is imported only when it is used, so that `biresnerf submit` loads no torch.
"""

from __future__ import annotations

import signal
import sys
from importlib.metadata import EntryPoint, entry_points

import click

from biresnerf.errors import BiresnerfError, InputError

GROUP = "biresnerf.commands"
EXIT_FAILURE = 1
EXIT_INPUT = 2
EXIT_SIGINT = 128 + signal.SIGINT


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
            raise InputError(
                "extra_missing",
                f"needs the package {missing}, which is not installed.",
                where=f"biresnerf {point.name}",
                mend="Install it with: pip install 'biresnerf[service]'",
            )

        unavailable.help = f"(not installed: {missing})"
        return unavailable
    if not isinstance(command, click.Command):
        raise TypeError(f"entry point {point.name} is no click command")
    return command


@click.command(cls=_FoundCommands, context_settings={"help_option_names": ["-h", "--help"]})
@click.version_option(package_name="biresnerf")
def cli() -> None:
    """Refine the camera poses of an image set, here or through a service."""


def main() -> None:
    """Entry point. Exit status: 0 done, 2 input or usage to mend, 1 other failure, 130 Ctrl-C, 143 SIGTERM."""
    try:
        status = cli.main(standalone_mode=False)
        sys.exit(status if isinstance(status, int) else 0)
    except click.ClickException as error:
        error.show()
        sys.exit(error.exit_code)
    except (click.Abort, KeyboardInterrupt):
        click.echo("stopped", err=True)
        sys.exit(EXIT_SIGINT)
    except InputError as error:
        click.echo(f"error: {error}", err=True)
        sys.exit(EXIT_INPUT)
    except BiresnerfError as error:
        click.echo(f"error: {error}", err=True)
        sys.exit(EXIT_FAILURE)


if __name__ == "__main__":
    main()
