"""Links that show the page of one job, read-only and for a while: made, listed, recognised, revoked.

Signed links to single files are not kept: the database has their job's round, which they were signed with.
"""

from __future__ import annotations

import hashlib
import hmac
import re
import secrets
from typing import Any

from pydantic import Field

from biresnerf.wire.base import Record
from biresnerf.wire.results import LinkView
from workers.database.database import OwnedStore
from workers.database.ids import CROCKFORD, new_id
from workers.records import record_from_row
from workers.settings.errors import Conflict, LimitReached

MOST = 50  # living links to one job
# `brl_`, ten characters that may be shown, and 256 random bits, as those of an API key.
_FORM = re.compile(r"(brl_[0-9A-Z]{10})_[A-Za-z0-9_-]{43}", re.ASCII)
_NOBODY = bytes(32)
_MINE = "jobs.tenant = coalesce(%s, jobs.tenant)"
_LIVING = "result_links.expires_at > clock_timestamp()"


class OpenLink(Record):
    """A living link, and whose job it shows."""

    link: LinkView
    tenant: str = Field(description="Owner of the job.")


class ResultLinkStore(OwnedStore):
    """Links in the database. Get one from `workers.engine.open_stores`.

    Every method raises `Unavailable` (``database_unavailable``) where the database does not answer.
    """

    async def create(self, job_id: str, valid_s: int) -> tuple[LinkView, str]:
        """A new link and its text, which cannot be read again.

        Raises `NotFound`, `LimitReached`, `Conflict` (``result_not_ready``: a failed job is not for strangers).
        """
        prefix = "brl_" + "".join(secrets.choice(CROCKFORD) for _ in range(10))
        text = f"{prefix}_{secrets.token_urlsafe(32)}"
        async with self._database.transaction() as connection:
            # Locked, so that two requests do not pass the limit together.
            sql = (
                "SELECT state = 'succeeded' OR (state = 'cancelled' AND partial) AS shown"
                f" FROM jobs WHERE id = %s AND {_MINE} FOR UPDATE"
            )
            job = await connection.required_row(f"No job {job_id}.", sql, job_id, self._tenant)
            if not job["shown"]:
                raise Conflict("result_not_ready", "Only the page of a job with a result can be shared.")
            await connection.execute(
                f"DELETE FROM result_links WHERE job_id = %s AND NOT {_LIVING}", (job_id,)
            )
            count = await connection.only_row("SELECT count(*) FROM result_links WHERE job_id = %s", job_id)
            if count["count"] >= MOST:
                raise LimitReached("quota_exhausted", f"The job has {MOST} links; revoke one first.")
            row = await connection.only_row(
                "INSERT INTO result_links (id, job_id, prefix, sha256, expires_at)"
                " VALUES (%s, %s, %s, %s, clock_timestamp() + make_interval(secs => %s)) RETURNING *",
                *(new_id("lnk"), job_id, prefix, _digest(text), valid_s),
            )
            return _view(row), text

    async def list(self, job_id: str) -> tuple[LinkView, ...]:
        """The living links to a job, oldest first; raises `NotFound`."""
        async with self._database.transaction() as connection:
            sql = f"SELECT id FROM jobs WHERE id = %s AND {_MINE}"
            await connection.required_row(f"No job {job_id}.", sql, job_id, self._tenant)
            rows = await connection.rows(
                f"SELECT * FROM result_links WHERE job_id = %s AND {_LIVING} ORDER BY created_at, id", job_id
            )
        return tuple(_view(row) for row in rows)

    async def revoke(self, job_id: str, link_id: str) -> None:
        """End a link for good, from the next request on; raises `NotFound`."""
        sql = (
            "DELETE FROM result_links USING jobs WHERE jobs.id = job_id"
            f" AND result_links.id = %s AND job_id = %s AND {_MINE} RETURNING result_links.id"
        )
        async with self._database.transaction() as connection:
            await connection.required_row(f"No link {link_id}.", sql, link_id, job_id, self._tenant)

    async def share_round(self, job_id: str) -> int:
        """The round that links to files of the job are signed with now; raises `NotFound`."""
        sql = f"SELECT share_round FROM jobs WHERE id = %s AND {_MINE}"
        async with self._database.transaction() as connection:
            row = await connection.required_row(f"No job {job_id}.", sql, job_id, self._tenant)
        return int(row["share_round"])

    async def revoke_shares(self, job_id: str) -> None:
        """End all links to files of the job, by the next round; raises `NotFound`."""
        sql = f"UPDATE jobs SET share_round = share_round + 1 WHERE id = %s AND {_MINE} RETURNING id"
        async with self._database.transaction() as connection:
            await connection.required_row(f"No job {job_id}.", sql, job_id, self._tenant)

    async def recognise(self, text: str) -> OpenLink | None:
        """The living link with this text; None says no more than that there is none."""
        form = _FORM.fullmatch(text)
        rows = (
            await self._database.fetch(
                f"SELECT result_links.*, jobs.tenant, {_LIVING} AS living FROM result_links"
                " JOIN jobs ON jobs.id = job_id WHERE prefix = %s",
                form[1],
            )
            if form
            else []
        )
        same = hmac.compare_digest(_digest(text), bytes(rows[0]["sha256"]) if rows else _NOBODY)
        if not same or not rows or not rows[0]["living"]:
            return None
        return OpenLink(link=_view(rows[0]), tenant=rows[0]["tenant"])


def _digest(text: str) -> bytes:
    return hashlib.sha256(text.encode()).digest()


def _view(row: dict[str, Any]) -> LinkView:
    return record_from_row(LinkView, row)
