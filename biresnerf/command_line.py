"""The command `biresnerf`: finds its commands by their entry points and turns errors into exit codes.

A command's module is imported only when it is used, so that `biresnerf submit` loads no torch.
"""

from __future__ import annotations

import difflib
import sys
from importlib.metadata import EntryPoint, entry_points

import click

from biresnerf.commands import exit_codes
from biresnerf.commands.answers import with_code
from biresnerf.commands.machine.completion import NAME
from biresnerf.errors import BiresnerfError, InputError
from biresnerf.openmp import let_waiting_threads_sleep

GROUP = "biresnerf.commands"
# What brings a package that is not installed; all others come with the service.
_EXTRAS = {
    "httpx": "client",
    "anyio": "client",
    "scipy": "compare",
    "matplotlib": "compare",
    "pycolmap": "colmap",
}
# How `biresnerf --help` lists them.
_SECTIONS = {
    "On this machine": (
        *("refine", "inspect", "evaluate", "convert", "export", "report", "make-scene"),
        *("compare", "study", "bench", "doctor", "completion"),
    ),
    "At a service": (
        *("submit", "list", "status", "wait", "logs", "download", "fork", "cancel", "delete"),
    ),
    "Run a service": (
        *("up", "demo", "api", "worker", "dispatcher", "migrate", "keys", "tenants", "backup", "restore"),
    ),
}  # fmt: skip


class _FoundCommands(click.Group):
    """Commands by entry point."""

    def list_commands(self, ctx: click.Context) -> list[str]:
        return sorted(point.name for point in entry_points(group=GROUP))

    def get_command(self, ctx: click.Context, cmd_name: str) -> click.Command | None:
        for point in entry_points(group=GROUP, name=cmd_name):
            return _loaded(point)
        return None

    def format_commands(self, ctx: click.Context, formatter: click.HelpFormatter) -> None:
        there = self.list_commands(ctx)
        named = {name for names in _SECTIONS.values() for name in names}
        sections = {**_SECTIONS, "Others": tuple(name for name in there if name not in named)}
        for title, names in sections.items():
            rows = [(name, _first_sentence(self.get_command(ctx, name))) for name in names if name in there]
            if rows:
                with formatter.section(title):
                    formatter.write_dl(rows)

    def resolve_command(
        self, ctx: click.Context, args: list[str]
    ) -> tuple[str | None, click.Command | None, list[str]]:
        try:
            return super().resolve_command(ctx, args)
        except click.UsageError as error:
            near = difflib.get_close_matches(args[0], self.list_commands(ctx), 1)
            if not near:
                raise
            raise click.UsageError(f"{error.message} Did you mean {near[0]!r}?", ctx) from None


def _first_sentence(command: click.Command | None) -> str:
    """All of it, where click's own short help cuts it off."""
    paragraph = " ".join((command.help or "").split("\n\n")[0].split()) if command is not None else ""
    return paragraph.split(". ")[0].removesuffix(".")


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
        hint=f"Install it with: pip install 'biresnerf[{extra}]'",
    )


@click.command(cls=_FoundCommands, context_settings={"help_option_names": ["-h", "--help"]})
@click.version_option(package_name="biresnerf")
def cli() -> None:
    """Refine the camera poses of an image set, here or through a service.

    biresnerf COMMAND --help says what a command does and takes.
    """


def main() -> None:
    """Entry point; `exit_codes` says what the exit status means."""
    let_waiting_threads_sleep()
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
        click.echo(f"error: {with_code(error)}", err=True)
        sys.exit(exit_codes.INPUT)
    except (BiresnerfError, OSError) as error:
        click.echo(f"error: {with_code(error)}", err=True)
        sys.exit(exit_codes.FAILED)


if __name__ == "__main__":
    main()
