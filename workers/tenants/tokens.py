"""Secret tokens: shown once, and recognised when a client sends them. Only their SHA-256 is stored.

A token's text is its kind, such as `brn`, ten characters that may be shown, and 256 random bits.
"""

from __future__ import annotations

import hashlib
import hmac
import re
import secrets
from typing import LiteralString, NamedTuple

from psycopg.rows import DictRow

from workers.database.database import Database
from workers.database.ids import CROCKFORD

_NOBODY = bytes(32)


class Token(NamedTuple):
    """A new token: its prefix, its text, which cannot be read again, and its digest."""

    prefix: str
    text: str
    sha256: bytes


def new_token(kind: str) -> Token:
    """A new token, which nobody can guess."""
    prefix = f"{kind}_" + "".join(secrets.choice(CROCKFORD) for _ in range(10))
    text = f"{prefix}_{secrets.token_urlsafe(32)}"
    return Token(prefix, text, _digest(text))


async def living_row(
    database: Database, kind: str, text: str, select: LiteralString, *values: object
) -> DictRow | None:
    """The row of the valid token with this text; None if there is none or it is no longer valid.

    ``select`` takes the ``values`` and then the prefix, and returns `sha256` and `living`. Raises `Unavailable`.
    """
    form = re.fullmatch(rf"({kind}_[0-9A-Z]{{10}})_[A-Za-z0-9_-]{{43}}", text, re.ASCII)
    rows = await database.fetch(select, *values, form[1]) if form else []
    # Takes the same time whether or not the prefix is known, and for each wrong digest.
    same = hmac.compare_digest(_digest(text), bytes(rows[0]["sha256"]) if rows else _NOBODY)
    return rows[0] if same and rows and rows[0]["living"] else None


def _digest(text: str) -> bytes:
    # No slow hash: 256 random bits cannot be guessed, however fast one tries.
    return hashlib.sha256(text.encode()).digest()
