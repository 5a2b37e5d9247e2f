"""docs/commands.md, from the help of every command."""

from __future__ import annotations

import pkgutil
from inspect import cleandoc
from pathlib import Path

import click

from biresnerf.command_line import SECTIONS, first_sentence
from docs.generate.markdown import table

ROOT = Path(__file__).resolve().parents[2]

_HEAD = """# Commands

Written by `make docs` from the commands' own help; a test fails when they differ. `biresnerf COMMAND --help` says the same.

"""


def all_commands() -> dict[str, click.Command]:
    """Every command of `biresnerf` by name, those of groups as ``keys create``."""
    targets = {name: target for section in SECTIONS for name, target in section.commands.items()}
    found: dict[str, click.Command] = {}
    for name in sorted(targets):
        command = pkgutil.resolve_name(targets[name])
        if isinstance(command, click.Group):
            found |= {f"{name} {part}": command.commands[part] for part in sorted(command.commands)}
        else:
            found[name] = command
    return found


def commands_page() -> str:
    """The page."""
    commands = all_commands()
    rows = [
        (f"[`{name}`](#{name.replace(' ', '-')})", first_sentence(command))
        for name, command in commands.items()
    ]
    sections = [_section(name, command) for name, command in commands.items()]
    return "\n".join((_HEAD + table(("command", "does"), rows), *sections))


def _section(name: str, command: click.Command) -> str:
    context = click.Context(command, info_name=f"biresnerf {name}")
    usage = " ".join(command.collect_usage_pieces(context))
    rows = []
    for parameter in command.get_params(context):
        record = parameter.get_help_record(context) if isinstance(parameter, click.Option) else None
        if record and "--help" not in record[0]:
            rows.append((f"`{record[0]}`", " ".join(record[1].split()) or "–"))
    text = "\n\n".join(" ".join(part.split()) for part in cleandoc(command.help or "").split("\n\n"))
    parts = [f"## {name}\n", f"`biresnerf {name} {usage}`\n", text + "\n"]
    if rows:
        parts.append(table(("option", ""), rows))
    return "\n".join(parts)
