"""Links that show one job's page, read-only and for a limited time: created, listed, recognised, revoked.

Signed links to single files are not stored, only their job's round, with which they were signed.
"""

from __future__ import annotations

from typing import Any

from biresnerf.wire.results import LinkView
from workers.database.database import OwnedStore
from workers.database.ids import new_id
from workers.jobs.job_rows import MINE
from workers.records import record_from_row
from workers.settings.errors import Conflict, LimitReached
from workers.tenants.tokens import living_row, new_token

MOST = 50  # valid links to one job
_LIVING = "result_links.expires_at > clock_timestamp()"


class ResultLinkStore(OwnedStore):
    """Links in the database. Get one from `workers.engine.open_stores`.

    Every method raises `Unavailable` (``database_unavailable``) if the database does not answer.
    """

    async def create(self, job_id: str, valid_s: int) -> tuple[LinkView, str]:
        """A new link and its text, which cannot be read again.

        Raises `NotFound`, `LimitReached`, `Conflict` (``result_not_ready``: a failed job cannot be shared).
        """
        prefix, text, sha256 = new_token("brl")
        async with self._database.transaction() as connection:
            # Locked, so that two requests do not pass the limit together.
            sql = (
                "SELECT state = 'succeeded' OR (state = 'cancelled' AND partial) AS shown"
                f" FROM jobs WHERE id = %s AND {MINE} FOR UPDATE"
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
                *(new_id("lnk"), job_id, prefix, sha256, valid_s),
            )
            return _view(row), text

    async def list(self, job_id: str) -> tuple[LinkView, ...]:
        """The valid links to a job, oldest first; raises `NotFound`."""
        async with self._database.transaction() as connection:
            sql = f"SELECT id FROM jobs WHERE id = %s AND {MINE}"
            await connection.required_row(f"No job {job_id}.", sql, job_id, self._tenant)
            rows = await connection.rows(
                f"SELECT * FROM result_links WHERE job_id = %s AND {_LIVING} ORDER BY created_at, id", job_id
            )
        return tuple(_view(row) for row in rows)

    async def revoke(self, job_id: str, link_id: str) -> None:
        """End a link for good, from the next request on; raises `NotFound`."""
        sql = (
            "DELETE FROM result_links USING jobs WHERE jobs.id = job_id"
            f" AND result_links.id = %s AND job_id = %s AND {MINE} RETURNING result_links.id"
        )
        async with self._database.transaction() as connection:
            await connection.required_row(f"No link {link_id}.", sql, link_id, job_id, self._tenant)

    async def share_round(self, job_id: str) -> int:
        """The round with which links to the job's files are currently signed; raises `NotFound`."""
        sql = f"SELECT share_round FROM jobs WHERE id = %s AND {MINE}"
        async with self._database.transaction() as connection:
            row = await connection.required_row(f"No job {job_id}.", sql, job_id, self._tenant)
        return int(row["share_round"])

    async def revoke_shares(self, job_id: str) -> None:
        """Revoke all links to files of the job by starting the next round; raises `NotFound`."""
        sql = f"UPDATE jobs SET share_round = share_round + 1 WHERE id = %s AND {MINE} RETURNING id"
        async with self._database.transaction() as connection:
            await connection.required_row(f"No job {job_id}.", sql, job_id, self._tenant)

    async def recognise(self, text: str) -> tuple[LinkView, str] | None:
        """The valid link with this text, and the owner of its job; None for any other text."""
        select = (
            f"SELECT result_links.*, jobs.tenant, {_LIVING} AS living FROM result_links"
            " JOIN jobs ON jobs.id = job_id WHERE prefix = %s"
        )
        row = await living_row(self._database, "brl", text, select)
        return None if row is None else (_view(row), row["tenant"])


def _view(row: dict[str, Any]) -> LinkView:
    return record_from_row(LinkView, row)
