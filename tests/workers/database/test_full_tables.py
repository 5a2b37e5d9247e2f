"""With thousands of jobs that are over, nothing that happens every few seconds reads all of them."""

from __future__ import annotations

import pytest

from benchmarks.load.parts import fill
from biresnerf.options.refine_options import RefineOptions
from tests.workers.database.full_tables import Copies, Operations, rows_scanned
from workers.database.database import open_database
from workers.engine import Stores
from workers.settings.settings import Settings

pytestmark = pytest.mark.anyio
OVER, WAITING = 4000, 60
# What a tenant's datasets hold is the sum over all of them.
LARGE = {"jobs", "job_events"}


async def test_no_operation_scans_the_jobs(stores: Stores, settings: Settings, dataset_id: str):
    async with open_database(settings.require_database_url(), connections=1) as database:
        operations = Operations(database, stores, settings, dataset_id)
        job, _ = await stores.jobs.submit(dataset_id, RefineOptions(preset="fast"))
        await operations.work()
        assert (await stores.jobs.get(job.id)).state == "succeeded"
        await Copies(database, job.id).make(OVER)
        await operations.all()["expiry's round"]()  # gives them their dates
        await fill(database, dataset_id, WAITING)
        scans = {}
        for name, operation in operations.all().items():
            read = await rows_scanned(database, operation, 3)
            scans[name] = {table: rows for table, rows in read.items() if table in LARGE}
    assert {name: tables for name, tables in scans.items() if tables} == {}
