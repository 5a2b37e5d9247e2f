"""docs/commands.md, from the help of every command."""

from __future__ import annotations

import itertools
import pkgutil
from collections import Counter
from collections.abc import Container, Iterable
from inspect import cleandoc
from pathlib import Path

import click

from biresnerf.command_line import SECTIONS
from docs.generate.markdown import table

ROOT = Path(__file__).resolve().parents[2]

Row = tuple[str, str]

SHARED_BY = 5  # commands; an option that so many share is described once
ALIKE = 6  # options that a command shares with an earlier one; so many are described only there

_HEAD = """# Commands: all options

Written by `make docs` from `biresnerf COMMAND --help`. [command-line.md](command-line.md) groups the commands by what they are for, and lists the exit statuses.

"""
_SHARED = """
## Options of several commands

"""


def all_commands() -> dict[str, click.Command]:
    """Every command of `biresnerf` by name; those of groups as in ``keys create``."""
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
    links = ", ".join(f"[`{name}`](#{name.replace(' ', '-')})" for name in commands)
    rows = {name: _options(command) for name, command in commands.items()}
    shared = shared_options(rows.values())
    sections = [
        _section(name, command, shared, like_earlier(name, rows, shared))
        for name, command in commands.items()
    ]
    return "\n".join((_HEAD + links + "\n" + _SHARED + table(("option", ""), shared), *sections))


def shared_options(options: Iterable[list[Row]]) -> list[Row]:
    """Options that `SHARED_BY` commands or more describe in the same words."""
    counts = Counter(row for rows in options for row in rows)
    return [row for row, count in counts.items() if count >= SHARED_BY]


def like_earlier(name: str, rows: dict[str, list[Row]], shared: Container[Row]) -> tuple[str, list[Row]]:
    """The first earlier command that shares `ALIKE` or more of this one's own options word for word, and these."""
    own = [row for row in rows[name] if row not in shared]
    for earlier in itertools.takewhile(lambda other: other != name, rows):
        alike = [row for row in own if row in rows[earlier]]
        if len(alike) >= ALIKE:
            return earlier, alike
    return "", []


def _options(command: click.Command) -> list[Row]:
    context = click.Context(command)
    rows = []
    for parameter in command.get_params(context):
        record = parameter.get_help_record(context) if isinstance(parameter, click.Option) else None
        if record and "--help" not in record[0]:
            rows.append((f"`{record[0]}`", " ".join(record[1].split()) or "–"))
    return rows


def _section(name: str, command: click.Command, shared: Container[Row], like: tuple[str, list[Row]]) -> str:
    context = click.Context(command, info_name=f"biresnerf {name}")
    usage = " ".join(command.collect_usage_pieces(context))
    text = "\n\n".join(" ".join(part.split()) for part in cleandoc(command.help or "").split("\n\n"))
    parts = [f"## {name}\n", f"`biresnerf {name} {usage}`\n", text + "\n"]
    options = _options(command)
    earlier, alike = like
    if own := [row for row in options if row not in shared and row not in alike]:
        parts.append(table(("option", ""), own))
    if alike:
        listed = ", ".join(row[0] for row in alike)
        parts.append(f"[As of `{earlier}`](#{earlier.replace(' ', '-')}): {listed}.\n")
    if common := [row[0] for row in options if row in shared]:
        parts.append("[Also](#options-of-several-commands): " + ", ".join(common) + ".\n")
    return "\n".join(parts)
