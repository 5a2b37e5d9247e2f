"""Logging of every process: one line per record, plain or JSON, with its context.

Client input is escaped, so it can neither start a line nor control a terminal; secrets are masked.
"""

from __future__ import annotations

import contextlib
import json
import logging
import re
import sys
import time
from collections.abc import Iterator, Mapping
from contextvars import ContextVar
from types import TracebackType
from typing import Any
from urllib.parse import urlsplit

from pydantic import SecretStr

from workers.settings.settings import Settings

_CONTEXT: ContextVar[Mapping[str, str]] = ContextVar("log_context", default={})  # noqa: B039 - never changed
# Control characters, line and paragraph separators, and marks that change the text direction.
_UNPRINTABLE = re.compile(
    r"[\x00-\x1f\x7f-\x9f\u2028\u2029\u200e\u200f\u202a-\u202e\u2066-\u2069\ud800-\udfff]"
)
_SECRETS = (
    (re.compile(r"(://[^:/@\s]*):[^@\s/]+@"), r"\1:***@"),
    (re.compile(r"\b(bearer|basic)\s+[\w.~+/=-]{6,}", re.IGNORECASE), r"\1 ***"),
    (re.compile(r"\b(whsec_|brn_)[\w+/=-]{6,}"), r"\1***"),
    (
        re.compile(
            r"\b((?:x-amz-(?:signature|credential|security-token)|token|signature|secret)=)[^&\s\"']+", re.I
        ),
        r"\1***",
    ),
)
_HIDDEN_LENGTH_MIN = 6
# Libraries that log addresses with secrets, or repeat what we log ourselves.
_QUIET = {"httpx": logging.WARNING, "httpcore": logging.WARNING, "psycopg.pool": logging.WARNING}
# While the database is away, its pool logs every attempt.
_REPEATING, _REPEAT_S = "psycopg.pool", 60.0


@contextlib.contextmanager
def log_context(**what: str | None) -> Iterator[None]:
    """Adds ``what``, except empty values, to all records logged in the block by this task and those it starts."""
    token = _CONTEXT.set({**_CONTEXT.get(), **{name: text for name, text in what.items() if text}})
    try:
        yield
    finally:
        _CONTEXT.reset(token)


def set_up_logging(process: str, settings: Settings) -> None:
    """Sends all records of this process to standard error in the configured format."""
    hidden = _secret_values(settings)
    form = JsonLines(process, hidden) if settings.log_format == "json" else PlainLines(process, hidden)
    handler = logging.StreamHandler(sys.stderr)
    handler.setFormatter(form)
    handler.addFilter(_with_context)
    logging.basicConfig(level=settings.log_level, handlers=[handler], force=True)
    logging.captureWarnings(True)
    for name, level in _QUIET.items():
        logging.getLogger(name).setLevel(level)
    logging.getLogger(_REPEATING).addFilter(OncePerMinute())
    sys.excepthook = _log_uncaught


def escaped(text: str) -> str:
    """The text on one line, with everything unprintable written out."""
    return _UNPRINTABLE.sub(lambda found: found[0].encode("unicode_escape").decode(), text)


def _with_context(record: logging.LogRecord) -> bool:
    record.context = {**_CONTEXT.get(), **getattr(record, "fields", {})}
    return True


class OncePerMinute(logging.Filter):
    """Lets each kind of record pass once a minute."""

    def __init__(self) -> None:
        super().__init__()
        self._passed: dict[str, float] = {}

    def filter(self, record: logging.LogRecord) -> bool:
        """Whether no record with the same text, before its values are filled in, passed in the last minute."""
        kind = str(record.msg)
        if record.created - self._passed.get(kind, -_REPEAT_S) < _REPEAT_S:
            return False
        self._passed[kind] = record.created
        return True


def _secret_values(settings: Settings) -> tuple[str, ...]:
    """Values of secret settings, which are masked in every log line."""
    fields = Settings.model_fields
    values = [(value, fields[name].repr) for name, value in settings]
    found = {value.get_secret_value() for value, _ in values if isinstance(value, SecretStr)}
    found |= {value for value, shown in values if isinstance(value, str) and not shown}
    if settings.database_url is not None:
        found.add(urlsplit(settings.database_url).password or "")
    return tuple(sorted((text for text in found if len(text) >= _HIDDEN_LENGTH_MIN), key=len, reverse=True))


class _Lines(logging.Formatter):
    """The base of both formats: time, masking of secrets, and the text of an exception."""

    def __init__(self, process: str, hidden: tuple[str, ...]) -> None:
        super().__init__()
        self._process, self._hidden = process, hidden

    def _safe(self, text: str) -> str:
        for secret in self._hidden:
            text = text.replace(secret, "***")
        for pattern, instead in _SECRETS:
            text = pattern.sub(instead, text)
        return text

    def _time(self, record: logging.LogRecord) -> str:
        seconds = time.strftime("%Y-%m-%dT%H:%M:%S", time.gmtime(record.created))
        return f"{seconds}.{int(record.msecs):03d}Z"

    def _context(self, record: logging.LogRecord) -> dict[str, Any]:
        context: dict[str, Any] = getattr(record, "context", {})
        return {
            name: self._safe(value) if isinstance(value, str) else value for name, value in context.items()
        }

    def _exception(self, record: logging.LogRecord) -> str:
        return self._safe(self.formatException(record.exc_info)) if record.exc_info else ""


class PlainLines(_Lines):
    """For people: time, process, level, message, and the context in brackets."""

    def format(self, record: logging.LogRecord) -> str:
        """The record as a line; an exception follows, indented, so that its lines cannot look like records."""
        line = f"{self._time(record)} {self._process} {record.levelname} {self._safe(record.getMessage())}"
        context = " ".join(f"{name}={value}" for name, value in self._context(record).items())
        lines = [escaped(f"{line} [{context}]" if context else line)]
        lines += [f"    {escaped(text)}" for text in self._exception(record).splitlines()]
        return "\n".join(lines)


class JsonLines(_Lines):
    """For machines: one JSON object per line."""

    def format(self, record: logging.LogRecord) -> str:
        """The record as one line of JSON."""
        line: dict[str, Any] = {
            "time": self._time(record),
            "level": record.levelname,
            "process": self._process,
            "logger": record.name,
            "message": self._safe(record.getMessage()),
            **self._context(record),
        }
        if record.exc_info:
            line["exception"] = self._exception(record)
        return json.dumps(line, default=str)


def _log_uncaught(kind: type[BaseException], error: BaseException, traceback: TracebackType | None) -> None:
    if issubclass(kind, KeyboardInterrupt):
        sys.__excepthook__(kind, error, traceback)
        return
    logging.getLogger(__name__).critical("the process ends by an error", exc_info=(kind, error, traceback))
