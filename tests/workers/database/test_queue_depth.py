"""The view that autoscalers read, on the real database, as a role that may read nothing else."""

from __future__ import annotations

import psycopg
import pytest

from tests.workers.conftest import Counting, Slots, claimed, taken_by_somebody
from tests.workers.queue.test_exports_beside import submit_export
from workers.database.job_queue import EXPORTS, REFINEMENTS
from workers.jobs.ledger import Ledger
from workers.settings.settings import Settings

pytestmark = pytest.mark.anyio


def depth(connection: psycopg.Connection, kind: str) -> tuple[int, int, int, float]:
    row = connection.execute(
        "SELECT waiting, held, running, oldest_s FROM queue_depth WHERE slot_kind = %s", (kind,)
    ).fetchone()
    return tuple(row)


async def test_it_tells_what_waits_what_is_held_and_what_runs_where(
    counting: Counting, settings: Settings, slots: Slots, scaler: psycopg.Connection
):
    assert depth(scaler, "cpu") == depth(scaler, "gpu") == (0, 0, 0, 0.0)
    first = await counting.submit(1000, 0.05)
    await counting.stores.jobs._database.fetch(
        "UPDATE jobs SET created_at = created_at - interval '90 s' WHERE id = %s", first
    )
    waiting, held, running, oldest_s = depth(scaler, "gpu")
    assert (waiting, held, running) == (1, 0, 0)
    assert 90 <= oldest_s < 150
    slots.start(settings, "gpu0")
    await counting.until(lambda job: job.state == "running")
    assert depth(scaler, "gpu") == (0, 0, 1, 0.0)
    assert depth(scaler, "cpu") == (0, 0, 0, 0.0)
    await counting.stores.jobs._database.fetch("UPDATE tenants SET max_running = 2 WHERE id = 'local'")
    await counting.submit(5, 0.01)
    await counting.submit(5, 0.01)
    waiting, held, running, oldest_s = depth(scaler, "gpu")
    assert (waiting, held, running) == (1, 1, 1), "the third job waits for its tenant's limit"
    assert depth(scaler, "cpu")[:3] == (1, 1, 0)
    assert 0 < oldest_s < 60
    for job in (first, counting.id):
        await counting.stores.jobs.cancel(job)


async def test_an_export_needs_a_slot_only_where_no_refinement_waits_or_runs(
    counting: Counting, scaler: psycopg.Connection
):
    database = counting.stores.jobs._database
    refinement = await counting.submit(5, 0.01)
    export = await submit_export(counting)
    assert depth(scaler, "cpu")[:3] == (1, 0, 0)
    await taken_by_somebody(database, [REFINEMENTS])
    claim = await claimed(database, refinement)
    assert claim is not None
    waiting, held, running, oldest_s = depth(scaler, "cpu")
    assert (waiting, held, running) == (0, 0, 1)
    assert oldest_s > 0, "the export waits"
    await taken_by_somebody(database, [EXPORTS])
    assert await claimed(database, export.id) is not None
    assert depth(scaler, "cpu") == (0, 0, 1, 0.0)
    await Ledger(database, claim, 60.0).publish([], None)
    await submit_export(counting, 1)
    assert depth(scaler, "cpu")[:3] == (1, 0, 1)
    assert depth(scaler, "gpu")[:3] == (1, 0, 0)


async def test_a_reader_of_the_view_reads_nothing_else(scaler: psycopg.Connection):
    for table in ("jobs", "tenants", "api_keys", "procrastinate_jobs"):
        with pytest.raises(psycopg.errors.InsufficientPrivilege):
            scaler.execute(f"SELECT * FROM {table}".encode())
