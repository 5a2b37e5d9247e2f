"""Output of commands: one JSON document, or lines of text."""

from __future__ import annotations

import json
import math
from collections.abc import Sequence
from typing import Any

import click
from pydantic import BaseModel

json_option = click.option(
    "--json", "as_json", is_flag=True, help="Print one JSON document, and nothing else."
)


def print_json(answer: BaseModel | dict[str, Any] | Sequence[BaseModel]) -> None:
    """Print one JSON document on standard output; NaN and infinity become null."""
    if isinstance(answer, BaseModel):
        click.echo(answer.model_dump_json(indent=1))
    else:
        click.echo(json.dumps(_plain(answer), indent=1, ensure_ascii=False, allow_nan=False))


def _plain(value: Any) -> Any:
    if isinstance(value, BaseModel):
        return value.model_dump(mode="json")
    if isinstance(value, dict):
        return {key: _plain(item) for key, item in value.items()}
    if isinstance(value, list | tuple):
        return [_plain(item) for item in value]
    return None if isinstance(value, float) and not math.isfinite(value) else value


def show(answer: BaseModel | dict[str, Any] | Sequence[BaseModel], text: str, *, as_json: bool) -> None:
    """Print the answer as one JSON document, or else the text."""
    if as_json:
        print_json(answer)
    elif text:
        click.echo(text)


def with_code(error: Exception) -> str:
    """The error's message and its code, under which docs/troubleshooting.md lists it."""
    code = getattr(error, "code", None)
    return f"{error} [{code}]" if code else str(error)


def table(rows: Sequence[Sequence[str]]) -> str:
    """Rows as aligned columns."""
    widths = [max(len(row[column]) for row in rows) for column in range(len(rows[0]))] if rows else []
    return "\n".join(
        "  ".join(cell.ljust(width) for cell, width in zip(row, widths, strict=True)).rstrip() for row in rows
    )
