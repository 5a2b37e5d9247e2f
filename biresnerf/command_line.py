"""The command `biresnerf`: the table of its commands, and how errors become exit codes.

A command's module is imported only when it is used, so that `biresnerf submit` loads no torch.
"""

from __future__ import annotations

import difflib
import pkgutil
import sys
from typing import NamedTuple

import click

from biresnerf.commands import exit_codes
from biresnerf.commands.answers import with_code
from biresnerf.commands.machine.completion import NAME
from biresnerf.errors import BiresnerfError, InputError
from biresnerf.openmp import let_waiting_threads_sleep


class Section(NamedTuple):
    """Commands that `biresnerf --help` lists together.

    Attributes:
        title: the section's heading.
        extra: the extra of this package that installs what they need; empty where they need none.
        commands: ``module:attribute`` of each command by its name.
    """

    title: str
    extra: str
    commands: dict[str, str]


SECTIONS = (
    Section(
        "On this machine",
        "",
        {
            "refine": "biresnerf.commands.poses.refine:refine_command",
            "inspect": "biresnerf.commands.poses.inspect:inspect_command",
            "split": "biresnerf.commands.poses.split:split_command",
            "evaluate": "biresnerf.commands.poses.evaluate:evaluate_command",
            "compare-results": "biresnerf.commands.poses.compare_results:compare_results_command",
            "convert": "biresnerf.commands.poses.convert:convert_command",
            "export": "biresnerf.commands.poses.export:export_command",
            "view": "biresnerf.commands.poses.view:view_command",
            "report": "biresnerf.commands.poses.report:report_command",
            "make-scene": "biresnerf.commands.poses.make_scene:make_scene_command",
            "bench": "biresnerf.commands.machine.bench:bench_command",
            "doctor": "biresnerf.commands.machine.doctor:doctor_command",
            "completion": "biresnerf.commands.machine.completion:completion_command",
        },
    ),
    Section(
        "Through a service",
        "client",
        {
            "submit": "biresnerf.commands.jobs.submit:submit_command",
            "list": "biresnerf.commands.jobs.jobs:list_command",
            "status": "biresnerf.commands.jobs.jobs:status_command",
            "wait": "biresnerf.commands.jobs.jobs:wait_command",
            "logs": "biresnerf.commands.jobs.jobs:logs_command",
            "download": "biresnerf.commands.jobs.download:download_command",
            "fork": "biresnerf.commands.jobs.fork:fork_command",
            "cancel": "biresnerf.commands.jobs.jobs:cancel_command",
            "delete": "biresnerf.commands.jobs.jobs:delete_command",
            "mcp": "biresnerf.commands.jobs.assistant_tools:mcp_command",
        },
    ),
    Section(
        "Run a service",
        "service",
        {
            "up": "service.commands.serve:up_command",
            "demo": "service.commands.serve:demo_command",
        },
    ),
    Section(
        "Operate a service of several processes or machines",
        "service",
        {
            "api": "service.commands.serve:api_command",
            "worker": "service.commands.serve:worker_command",
            "dispatcher": "service.commands.upkeep:dispatcher_command",
            "migrate": "service.commands.serve:migrate_command",
            "keys": "service.commands.keys:keys_command",
            "tenants": "service.commands.tenants:tenants_command",
            "backup": "service.commands.upkeep:backup_command",
            "restore": "service.commands.upkeep:restore_command",
        },
    ),
    Section(
        "Research",
        "studies",
        {
            "compare": "biresnerf.studies.commands.compare:compare_command",
            "study": "biresnerf.studies.commands.study:study_command",
        },
    ),
)


class _LazyCommands(click.Group):
    """The commands of `SECTIONS`, each imported when it is first used."""

    def list_commands(self, ctx: click.Context) -> list[str]:
        return sorted(name for section in SECTIONS for name in section.commands)

    def get_command(self, ctx: click.Context, cmd_name: str) -> click.Command | None:
        for section in SECTIONS:
            if cmd_name in section.commands:
                return _load(section, cmd_name)
        return None

    def format_commands(self, ctx: click.Context, formatter: click.HelpFormatter) -> None:
        for section in SECTIONS:
            with formatter.section(section.title):
                formatter.write_dl(
                    [(name, first_sentence(_load(section, name))) for name in section.commands]
                )

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


def first_sentence(command: click.Command) -> str:
    """The first sentence of a command's help, uncut (click's own short help is cut at 45 characters)."""
    paragraph = " ".join((command.help or "").split("\n\n")[0].split())
    return paragraph.split(". ")[0].removesuffix(".")


def _load(section: Section, name: str) -> click.Command:
    try:
        command = pkgutil.resolve_name(section.commands[name])
    except ModuleNotFoundError as error:
        return _unavailable(name, error.name, section.extra)
    if not isinstance(command, click.Command):
        raise TypeError(f"{section.commands[name]} is not a click command")
    return command


def _unavailable(name: str, package: str | None, extra: str) -> click.Command:
    """Stands in for a command that cannot be imported; raises `InputError` ``extra_missing`` when it runs."""

    @click.command(name, context_settings={"ignore_unknown_options": True, "allow_extra_args": True})
    def unavailable() -> None:
        raise InputError(
            "extra_missing",
            f"needs the package {package}, which is not installed.",
            where=f"biresnerf {name}",
            hint=f"Install it with: pip install 'biresnerf{f'[{extra}]' if extra else ''}'",
        )

    unavailable.help = f"(not installed: {package})"
    return unavailable


@click.command(cls=_LazyCommands, context_settings={"help_option_names": ["-h", "--help"]})
@click.version_option(package_name="biresnerf")
def cli() -> None:
    """Refine the camera poses of an image set, on this machine or through a service.

    Run `biresnerf COMMAND --help` for what a command does and its options.
    """


def main() -> None:
    """Runs a command and exits with a status of `exit_codes`."""
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
