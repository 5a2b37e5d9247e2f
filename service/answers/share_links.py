"""Links to one file of a result that need no key: signed, and good until a time that stands in them."""

from __future__ import annotations

import base64
import hashlib
import hmac
import time

from service.http.problems import ProblemError


def signature(key: bytes, job_id: str, name: str, expires: int) -> str:
    """What only a holder of ``key`` can make for this file and time."""
    said = "\n".join(["biresnerf share 1", job_id, str(expires), name]).encode()
    return base64.urlsafe_b64encode(hmac.digest(key, said, hashlib.sha256)).decode().rstrip("=")


def require_signature(key: bytes, job_id: str, name: str, expires: int, given: str) -> None:
    """Raises ``ProblemError``: ``not_found`` for a link we never made, ``link_expired`` for an old one."""
    made = signature(key, job_id, name, expires)
    if not hmac.compare_digest(made.encode(), given.encode(errors="replace")):
        raise ProblemError("not_found", "This service never gave out such a link.")
    if expires < time.time():
        raise ProblemError("link_expired", "The link was good for a time, which is over.")
