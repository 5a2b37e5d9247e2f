"""Ids of jobs and datasets: a prefix and a ULID (sorts by time, 80 random bits), and opaque cursors."""

from __future__ import annotations

import base64
import binascii
import json
import secrets
import time
from datetime import datetime

from biresnerf.errors import InputError

CROCKFORD = "0123456789ABCDEFGHJKMNPQRSTVWXYZ"


def new_id(prefix: str) -> str:
    """For example ``job_01J9Z3…`` (26 characters after the prefix)."""
    number = (int(time.time() * 1000) << 80) | secrets.randbits(80)
    return f"{prefix}_" + "".join(CROCKFORD[(number >> shift) & 31] for shift in range(125, -1, -5))


def cursor_after(*place: str | datetime) -> str:
    """An opaque cursor for the place where a page ended."""
    plain = [part.isoformat() if isinstance(part, datetime) else part for part in place]
    return base64.urlsafe_b64encode(json.dumps(plain).encode()).decode().rstrip("=")


def cursor_place(cursor: str, parts: int) -> list[str]:
    """Where the page ended; raises `InputError` (``bad_cursor``)."""
    try:
        place = json.loads(base64.urlsafe_b64decode(cursor + "=" * (-len(cursor) % 4)))
    except (ValueError, binascii.Error):
        place = None
    if not isinstance(place, list) or len(place) != parts or not all(isinstance(part, str) for part in place):
        raise InputError(
            "bad_cursor", "This is no cursor of this list.", where="cursor", hint="Start without one."
        )
    return place


def cursor_time(text: str) -> datetime:
    """The time in a cursor; raises `InputError` (``bad_cursor``)."""
    try:
        return datetime.fromisoformat(text)
    except ValueError:
        raise InputError("bad_cursor", "This is no cursor of this list.", where="cursor") from None
