"""Expires results, unused datasets, old records and idempotency keys.

Files go to the trash in the transaction that makes them unreachable; `workers.queue.janitor` deletes them and logs
it. Each row expires once, however many dispatchers run.
"""

from __future__ import annotations

import asyncio
import logging
import math
import time
from datetime import datetime, timedelta

import psycopg

from workers.database.database import Connection, Database
from workers.jobs.job_expiry import (
    datasets_used_since,
    date_jobs,
    date_new_jobs,
    delete_expired_jobs,
    expire_jobs,
    forget_keys,
)
from workers.process.waiting import first_done
from workers.settings.errors import Unavailable
from workers.settings.settings import Settings
from workers.store.trash import discard

log = logging.getLogger(__name__)

BATCH = 100
# A locked dataset is in use, and tried again later. Submissions share its lock: waiting for overlapping ones could last
# forever.
_UNUSED = "SELECT 1 FROM datasets WHERE id = %s FOR UPDATE SKIP LOCKED"
# Only one dispatcher at a time updates the dates and deletes.
EXPIRY_LOCK = 7_201_606
_DATE_DATASETS = """
    UPDATE datasets SET expires_at = due.at FROM (
        SELECT kept.id, date.at FROM datasets AS kept
        LEFT JOIN (SELECT * FROM dataset_jobs {used}) AS used ON dataset_id = kept.id
        CROSS JOIN LATERAL (SELECT CASE WHEN coalesce(unfinished, 0) = 0 THEN
            greatest(touched_at, used_at) + make_interval(secs => %(kept_s)s) END AS at) AS date
        WHERE state IN ('open', 'ready', 'rejected') {dated} AND kept.expires_at IS DISTINCT FROM date.at
        FOR NO KEY UPDATE OF kept SKIP LOCKED) AS due
    WHERE due.id = datasets.id"""
_DATE_ALL = _DATE_DATASETS.format(used="", dated="")
_DATE_CHANGED = _DATE_DATASETS.format(
    used="WHERE dataset_id = ANY(%(ids)s)", dated="AND kept.id = ANY(%(ids)s)"
)
# How often all dates are updated: a setting may have changed, a job's record may be gone.
ALL_S = 3600.0
# Overlap of rounds: a transaction may have committed after the round that it belongs to.
OVERLAP_S = 600.0
DAY_S = 86_400.0


class Expiry:
    """The dispatcher's rounds of expiry."""

    def __init__(self, database: Database, settings: Settings) -> None:
        self._database, self._settings = database, settings
        self._all_at = -math.inf
        self._looked_at: datetime | None = None

    async def run(self, stop: asyncio.Event) -> None:
        """Run a round every ``expiry_s`` seconds until ``stop``."""
        while not stop.is_set():
            try:
                await self.round()
            except (Unavailable, psycopg.Error) as error:
                log.warning("nothing can be expired now: %s", error)
            await first_done(stop.wait(), asyncio.sleep(self._settings.expiry_s))

    async def round(self) -> None:
        """Update expiry dates, and expire what is due; raises `Unavailable`."""
        if not await self._set_dates():
            return
        for expire in (self._expire_jobs, self._expire_datasets):
            while await expire() == BATCH:
                pass
        await self._forget()

    async def _set_dates(self) -> bool:
        """Update expiry dates; returns False if another dispatcher is in charge."""
        results_s, datasets_s = (
            days * DAY_S or None
            for days in (self._settings.keep_results_days, self._settings.keep_datasets_days)
        )
        async with self._database.transaction() as connection:
            if not await _mine(connection):
                # The other one may have different settings, and may end at any time.
                self._looked_at = None
                return False
            now = await connection.value("SELECT clock_timestamp()")
            if self._looked_at is None or time.monotonic() >= self._all_at:
                self._all_at = time.monotonic() + ALL_S
                await date_jobs(connection, results_s)
                await connection.execute(_DATE_ALL, {"kept_s": datasets_s})
            else:
                await date_new_jobs(connection, results_s)
                ids = await _changed_datasets(connection, self._looked_at - timedelta(seconds=OVERLAP_S))
                await connection.execute(_DATE_CHANGED, {"kept_s": datasets_s, "ids": ids})
        self._looked_at = now
        return True

    async def _expire_jobs(self) -> int:
        return await self._database.run(expire_jobs, BATCH)

    async def _expire_datasets(self) -> int:
        rows = await self._database.fetch(
            "SELECT id FROM datasets WHERE expires_at <= now()"
            " AND state IN ('open', 'ready', 'rejected') ORDER BY expires_at LIMIT %s",
            BATCH,
        )
        return sum([await self._expire_dataset(row["id"]) for row in rows])

    async def _expire_dataset(self, dataset_id: str) -> bool:
        """Expire a dataset if it is due; returns False if it is in use."""
        kept_s = self._settings.keep_datasets_days * DAY_S
        async with self._database.transaction() as connection:
            # Lock first: the next statement sees earlier submissions, and later ones see ours.
            if await connection.row(_UNUSED, dataset_id) is None:
                return False
            row = await connection.row(
                "UPDATE datasets SET state = 'expired', revision = revision + 1 WHERE id = %s"
                " AND state IN ('open', 'ready', 'rejected') AND expires_at <= clock_timestamp()"
                " AND touched_at < clock_timestamp() - make_interval(secs => %s)"
                " AND NOT EXISTS (SELECT 1 FROM dataset_jobs WHERE dataset_id = datasets.id AND (unfinished > 0"
                " OR finished_at > clock_timestamp() - make_interval(secs => %s)))"
                " AND NOT EXISTS (SELECT 1 FROM uploads WHERE dataset_id = datasets.id"
                " AND expires_at > clock_timestamp() AND state IN ('receiving', 'received'))"
                " RETURNING tenant",
                dataset_id,
                kept_s,
                kept_s,
            )
            if row is None:
                await connection.execute("UPDATE datasets SET expires_at = NULL WHERE id = %s", (dataset_id,))
                return True
            what = await connection.row(
                "WITH gone AS (DELETE FROM dataset_files WHERE dataset_id = %s RETURNING size)"
                " SELECT count(*) AS files, coalesce(sum(size), 0)::bigint AS bytes FROM gone",
                dataset_id,
            )
            await connection.execute("DELETE FROM uploads WHERE dataset_id = %s", (dataset_id,))
            await discard(connection, f"datasets/{dataset_id}")
        log.info("expired %s of %s, unused: %s", dataset_id, row["tenant"], what)
        return True

    async def _forget(self) -> None:
        """Release idempotency keys, then delete old records of expired data and of deliveries."""
        await self._database.run(forget_keys, self._settings.keep_keys_hours * 3600)
        if not self._settings.keep_records_days:
            return
        old_s = self._settings.keep_records_days * DAY_S
        await self._database.run(delete_expired_jobs, old_s)
        for sql in (
            "DELETE FROM datasets WHERE state = 'expired'"
            " AND expires_at < now() - make_interval(secs => %s)"
            " AND NOT EXISTS (SELECT 1 FROM dataset_jobs WHERE dataset_id = datasets.id)",
            # Skips locked rows: deleting a webhook locks them in another order.
            "DELETE FROM webhook_deliveries WHERE id IN (SELECT id FROM webhook_deliveries"
            " WHERE finished_at < now() - make_interval(secs => %s) FOR UPDATE SKIP LOCKED)",
        ):
            await self._database.fetch(sql, old_s)


async def _changed_datasets(connection: Connection, since: datetime) -> list[str]:
    touched = await connection.rows("SELECT id FROM datasets WHERE touched_at > %s", since)
    return [*{row["id"] for row in touched} | set(await datasets_used_since(connection, since))]


async def _mine(connection: Connection) -> bool:
    return bool(await connection.value("SELECT pg_try_advisory_xact_lock(%s)", EXPIRY_LOCK))
