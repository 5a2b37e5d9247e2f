"""`--set key=value`: any refinement option, for every command that takes them."""

from __future__ import annotations

import json
from collections.abc import Callable
from typing import Any

import click

from biresnerf.errors import InputError


def parse_settings(texts: tuple[str, ...]) -> dict[str, Any]:
    """Values by key; a value that is not valid JSON is text. Raises `InputError`."""
    settings: dict[str, Any] = {}
    for text in texts:
        key, separator, value = text.partition("=")
        if not separator or not key:
            raise InputError("invalid_options", f"{text!r} is not key=value.", where="--set")
        if key in settings:
            raise InputError("invalid_options", f"{key} is set twice.", where="--set")
        try:
            settings[key] = json.loads(value)
        except ValueError:
            settings[key] = value
    return settings


def settings_option(command: Callable[..., Any]) -> Callable[..., Any]:
    """Give a click command the option `--set`, as a dict named `settings`."""
    return click.option(
        "--set",
        "settings",
        multiple=True,
        metavar="KEY=VALUE",
        callback=lambda _context, _parameter, texts: parse_settings(texts),
        help="Set any other option; may be repeated. docs/options.md and GET /v1/options list them.",
    )(command)
