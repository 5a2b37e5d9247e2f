"""Conditional and range requests (RFC 9110, sections 13 and 14) as pure functions on header values."""

from __future__ import annotations

import re

from service.http.problems import ProblemError

_ETAG = re.compile(r'(?:W/)?"[\x21\x23-\x7e\x80-\xff]*"')
_RANGE = re.compile(r"^(\d{0,18})-(\d{0,18})$", re.ASCII)


def none_match(header: str | None, etag: str) -> bool:
    """Whether `If-None-Match` lets the request through (False means 304); compares weakly."""
    if header is None:
        return True
    if header.strip() == "*":
        return False
    return _opaque(etag) not in {_opaque(tag) for tag in _ETAG.findall(header)}


def _opaque(etag: str) -> str:
    return etag.removeprefix("W/")


def byte_range(header: str | None, if_range: str | None, etag: str, size: int) -> tuple[int, int] | None:
    """First and last byte of the requested part; None means the whole file.

    A range of another unit, several ranges and a stale `If-Range` get the whole file, as the RFC allows.

    Raises:
        ProblemError: ``bad_range`` (400) if the header is malformed; ``range_not_satisfiable`` (416).
    """
    if header is None or not header.strip().lower().startswith("bytes="):
        return None
    if if_range is not None and if_range.strip() != etag:
        return None
    spec = header.strip()[len("bytes=") :]
    if "," in spec:
        return None
    match = _RANGE.match(spec.strip())
    if match is None or match.groups() == ("", ""):
        raise ProblemError("bad_range", f"The range {header[:100]!r} is not of the form bytes=first-last.")
    first_text, last_text = match.groups()
    if first_text == "":
        first, last = max(size - int(last_text), 0), size - 1
    else:
        first, last = int(first_text), min(int(last_text), size - 1) if last_text else size - 1
        if last_text and int(last_text) < first:
            raise ProblemError("bad_range", f"The range {header[:100]!r} ends before it begins.")
    if first >= size:
        raise ProblemError(
            "range_not_satisfiable",
            f"The file has {size} bytes.",
            headers={"Content-Range": f"bytes */{size}"},
        )
    return first, last
