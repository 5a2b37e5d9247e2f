"""Tables and values in Markdown."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from typing import Any

DASH = "–"


def table(head: Sequence[str], rows: Iterable[Sequence[str]]) -> str:
    """A table; cells must not hold line breaks, and bars in them are escaped."""
    lines = [head, ["---"] * len(head), *rows]
    return "\n".join("| " + " | ".join(_cell(text) for text in line) + " |" for line in lines) + "\n"


def _cell(text: str) -> str:
    if "\n" in text:
        raise ValueError(f"a cell of a table cannot hold a line break: {text!r}")
    return text.replace("|", "\\|")


def code(value: Any) -> str:
    """A value as on the command line: in JSON, but text without quotes."""
    if isinstance(value, bool):
        return f"`{str(value).lower()}`"
    if isinstance(value, float):
        return f"`{value:g}`"
    if isinstance(value, tuple | list):
        return f"`[{', '.join(str(part) for part in value)}]`"
    return f"`{value}`"
