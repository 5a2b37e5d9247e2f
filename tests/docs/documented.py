"""Every command that README, SECURITY, docs/ and examples/ show: found in their fenced blocks."""

from __future__ import annotations

import re
import shlex
from dataclasses import dataclass
from pathlib import Path

ROOT = Path(__file__).resolve().parents[2]
PAGES = (
    *(ROOT / name for name in ("README.md", "SECURITY.md")),
    *sorted((ROOT / "docs").glob("*.md")),
    *sorted((ROOT / "examples").glob("*.md")),
)
SHELL, PYTHON = "sh", "python"
# Blocks of these hold no commands: formulas, trees, output of programs; test_typescript.py checks TypeScript.
OTHER = {"", "json", "yaml", "toml", "text", "sql", "ts"}
_FENCE = re.compile(r"^```(\w*)\n(.*?)^```", re.DOTALL | re.MULTILINE)
_STARTS = re.compile(r"^\s*(\$ |biresnerf |curl |docker |make |pip |python |podman )")


@dataclass(frozen=True)
class Command:
    """One command of a page, without its comment, its lines joined; or a whole block of Python."""

    page: str
    language: str
    text: str

    def __str__(self) -> str:
        return f"{self.page}: {self.text.splitlines()[0]}"


def commands_of(page: Path) -> list[Command]:
    """The page's commands in its order. Raises ValueError where a block of no language holds one."""
    found: list[Command] = []
    name = page.relative_to(ROOT).as_posix()
    for language, block in _FENCE.findall(page.read_text("utf-8")):
        if language == PYTHON:
            found.append(Command(name, PYTHON, block))
        elif language == SHELL:
            found += [Command(name, SHELL, text) for text in _shell_commands(block)]
        elif language not in OTHER or any(_STARTS.match(line) for line in block.splitlines()):
            raise ValueError(f"{name}: say which language this block is in (sh, python): {block[:80]!r}")
    return found


def all_commands() -> list[Command]:
    """Those of all pages."""
    return [command for page in PAGES for command in commands_of(page)]


def _shell_commands(block: str) -> list[str]:
    """Commands of a block: a line each, with those it is continued on by a backslash or inside quotes."""
    commands, parts = [], []
    for line in block.splitlines():
        parts.append(_without_comment(line))
        text = "\n".join(parts)
        if text.endswith("\\") or not _quotes_are_closed(text):
            continue
        if text.strip():
            commands.append(text.replace("\\\n", " "))
        parts = []
    if parts:
        raise ValueError(f"a command does not end: {parts!r}")
    return commands


def _quotes_are_closed(text: str) -> bool:
    try:
        shlex.split(text)
    except ValueError:
        return False
    return True


def _without_comment(line: str) -> str:
    """A comment begins at a # at the line's start, or after a space outside of quotes."""
    quote = ""
    for index, letter in enumerate(line):
        if quote:
            quote = "" if letter == quote else quote
        elif letter in "'\"":
            quote = letter
        elif letter == "#" and (index == 0 or line[index - 1] == " "):
            return line[:index].rstrip()
    return line.rstrip()
