"""`--set key=value`: any refinement option, for every command that takes them; and `--budget 2m`."""

from __future__ import annotations

import json
import re
from collections.abc import Callable
from typing import Any, get_origin

import click

from biresnerf.errors import InputError
from biresnerf.options.refine_options import RefineOptions

LISTS = {name for name, field in RefineOptions.model_fields.items() if get_origin(field.annotation) is tuple}


def parse_settings(texts: tuple[str, ...]) -> dict[str, Any]:
    """Values by key; a value that is not valid JSON is text, and a list with commas. Raises `InputError`."""
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
            settings[key] = [part.strip() for part in value.split(",")] if key in LISTS else value
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


_DURATION = re.compile(r"(?:(?P<h>[\d.]+)h)?(?:(?P<m>[\d.]+)m)?(?:(?P<s>[\d.]+)s?)?")


def parse_duration(text: str) -> float:
    """Seconds of ``90``, ``90s``, ``1.5m`` or ``1h30m``. Raises `InputError`."""
    found = _DURATION.fullmatch(text.strip().lower())
    try:
        h, m, s = (float(found[unit] or 0) for unit in "hms") if found and any(found.groups()) else (0.0,) * 3
    except ValueError:
        h = m = s = 0.0
    if not h and not m and not s:
        raise InputError(
            "invalid_options", f"{text!r} is no time.", where="--budget", hint="As in 90s, 2m, 1h30m."
        )
    return 3600 * h + 60 * m + s


def budget_option(command: Callable[..., Any]) -> Callable[..., Any]:
    """Give a click command the option `--budget`, as seconds or None named `time_budget_s`."""
    return click.option(
        "--budget",
        "time_budget_s",
        metavar="TIME",
        callback=lambda _context, _parameter, text: text and parse_duration(text),
        help="What the run may take, as 90s, 2m or 1h: fewer steps than the preset's, as many as fit.",
    )(command)
