"""Listings page by page."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import Protocol, TypeVar

from biresnerf.client.calls import Answer, Call, Flow, Session, ask

_PAGE = 200
Item = TypeVar("Item")
Listed = TypeVar("Listed", covariant=True)


class PageOf(Protocol[Listed]):
    """One page."""

    @property
    def items(self) -> Sequence[Listed]:
        """What is on it."""

    @property
    def next_cursor(self) -> str | None:
        """Leads to the next one; none on the last."""


def collect(
    session: Session, call: Call, read: Callable[[Answer], PageOf[Item]], limit: int | None
) -> Flow[list[Item]]:
    """The first ``limit`` items of a listing, or all of them."""
    found: list[Item] = []
    params = dict(call.params)
    while True:
        params["limit"] = _PAGE if limit is None else min(_PAGE, limit - len(found))
        page = read((yield from ask(session, replace(call, params=params))))
        found += page.items
        if page.next_cursor is None or (limit is not None and len(found) >= limit):
            return found
        params["cursor"] = page.next_cursor
