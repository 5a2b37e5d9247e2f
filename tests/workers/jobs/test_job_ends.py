"""What the end of a job leaves: no checkpoint, and files of attempts only for as long as one may still write them."""

from __future__ import annotations

from collections.abc import Awaitable, Callable

import pytest

from biresnerf.options.refine_options import RefineOptions
from biresnerf.wire.problems import JobError
from tests.workers.conftest import claimed, ready_dataset, taken_by_somebody
from workers.database.database import Database
from workers.engine import Stores
from workers.jobs.claim import Claim
from workers.jobs.job_states import Requeue
from workers.jobs.ledger import Ledger
from workers.queue.janitor import release_worker

pytestmark = pytest.mark.anyio
STALL_S = 2.0


async def _lost_after_its_cancel(database: Database, claim: Claim) -> None:
    await _ask(database, claim)
    await release_worker(database, None, STALL_S)


async def _given_back_after_its_cancel(database: Database, claim: Claim) -> None:
    await _ask(database, claim)
    assert not await Ledger(database, claim, STALL_S).give_back(Requeue("requeued", {"why": "shutdown"}))


async def _claimed_after_its_cancel(database: Database, claim: Claim) -> None:
    await _ask(database, claim)
    assert await claimed(database, claim.job_id, STALL_S) is None


async def _claimed_once_too_often(database: Database, claim: Claim) -> None:
    await database.fetch("UPDATE jobs SET crashes = 3 RETURNING id")
    assert await claimed(database, claim.job_id, STALL_S) is None


async def _failed(database: Database, claim: Claim) -> None:
    await Ledger(database, claim, STALL_S).fail(JobError(code="timeout", detail="too long"), [])


async def _succeeded(database: Database, claim: Claim) -> None:
    assert await Ledger(database, claim, STALL_S).publish([], None)


async def _ask(database: Database, claim: Claim) -> None:
    await database.fetch("UPDATE jobs SET cancel_requested = true WHERE id = %s RETURNING id", claim.job_id)


@pytest.mark.parametrize(
    ("end", "state"),
    [
        (_lost_after_its_cancel, "cancelled"),
        (_given_back_after_its_cancel, "cancelled"),
        (_claimed_after_its_cancel, "cancelled"),
        (_claimed_once_too_often, "failed"),
        (_failed, "failed"),
        (_succeeded, "succeeded"),
    ],
)
async def test_whoever_ends_a_job_has_its_attempts_deleted_after_twice_the_stall_time(
    stores: Stores, end: Callable[[Database, Claim], Awaitable[None]], state: str
):
    database = stores.jobs._database
    dataset_id = await ready_dataset(stores, {"plan.json": b"{}"})
    await stores.jobs.submit(dataset_id, RefineOptions(preset="fast"))
    entry = await taken_by_somebody(database)
    claim = await claimed(database, entry.job_id)
    assert claim is not None
    root = f"jobs/{claim.job_id}"
    await Ledger(database, claim, STALL_S).checkpoint(f"{root}/checkpoints/1", ["a"], 10)
    await Ledger(database, claim, STALL_S).reusable("seeding", f"{root}/stages/seeding/{claim.name}-2", ["b"])
    await end(database, claim)
    (job,) = await database.fetch("SELECT state, checkpoint FROM jobs")
    assert job == {"state": state, "checkpoint": None}
    rows = await database.fetch(
        "SELECT prefix, keep, extract(epoch FROM not_before - clock_timestamp())::float8 AS left_s FROM trash"
    )
    folders = ("checkpoints", "results", "previews", "stages/seeding", "stages/coarse")
    assert {row["prefix"] for row in rows} == {f"{root}/{name}" for name in folders}
    kept = {row["prefix"].removeprefix(f"{root}/stages/"): row["keep"] for row in rows}
    assert (kept["seeding"], kept["coarse"]) == (f"{claim.name}-2", None), "other jobs may start from it"
    assert all(STALL_S < row["left_s"] <= 2 * STALL_S for row in rows)
