"""What an attempt writes into its job, and that nobody else's writes get through."""

from __future__ import annotations

import pytest

from biresnerf.options.refine_options import RefineOptions
from biresnerf.progress import Progress
from biresnerf.wire.problems import JobError
from tests.workers.conftest import claimed, ready_dataset, taken_by_somebody
from workers.database.database import Database
from workers.engine import Stores
from workers.jobs import ledger as ledgers
from workers.jobs.claim import Fenced
from workers.jobs.job_states import Requeue
from workers.jobs.ledger import Ledger
from workers.records import Artifact
from workers.settings.errors import Unavailable

pytestmark = pytest.mark.anyio
FILE = Artifact(name="report.json", key="k", size=3, sha256="s", media_type="application/json")
STALL_S = 60.0
ERROR = JobError(code="timeout", detail="too long")


@pytest.fixture
def database(stores: Stores) -> Database:
    return stores.jobs._database


@pytest.fixture
async def ledger(stores: Stores, database: Database) -> Ledger:
    dataset_id = await ready_dataset(stores, {"plan.json": b"{}"})
    job, _ = await stores.jobs.submit(dataset_id, RefineOptions(preset="fast"))
    await taken_by_somebody(database)
    claim = await claimed(database, job.id)
    assert claim is not None
    return Ledger(database, claim, STALL_S)


async def events(stores: Stores, ledger: Ledger) -> list[str]:
    return [event.type for event in (await stores.jobs.update(ledger.claim.job_id)).events]


async def trash(database: Database) -> set[str]:
    return {row["prefix"] for row in await database.fetch("SELECT prefix FROM trash")}


async def test_progress_is_in_the_record_and_only_a_new_stage_is_an_event(stores: Stores, ledger: Ledger):
    await ledger.progress(Progress(stage="coarse", step=1, fraction=0.5, metrics={"loss": 2.0}))
    await ledger.progress(Progress(stage="coarse", step=2, fraction=0.4, metrics={"psnr": 3.0}, message="m"))
    job = await stores.jobs.get(ledger.claim.job_id)
    assert (job.stage, job.progress.step, job.message) == ("coarse", 2, "m")
    assert job.progress.fraction == 0.5, "never falls"
    assert job.metrics == {"loss": 2.0, "psnr": 3.0}
    assert await events(stores, ledger) == ["queued", "started", "stage"]
    await ledger.progress(Progress(stage="fine"))
    assert (await events(stores, ledger))[-1] == "stage"


async def test_a_new_checkpoint_takes_the_place_of_the_last_which_is_deleted(
    database: Database, ledger: Ledger
):
    await ledger.checkpoint("jobs/x/1", ["a"], 10)
    assert await trash(database) == set()
    await ledger.checkpoint("jobs/x/2", ["a"], 20)
    assert await trash(database) == {"jobs/x/1"}
    (row,) = await database.fetch("SELECT checkpoint FROM jobs")
    assert row["checkpoint"] == {"prefix": "jobs/x/2", "files": ["a"]}


async def test_the_work_of_each_stage_is_kept_once(database: Database, ledger: Ledger):
    await ledger.reusable("seeding", "jobs/x/s1", ["a"])
    await ledger.reusable("coarse", "jobs/x/c1", ["b"])
    await ledger.reusable("seeding", "jobs/x/s2", ["a"])
    assert await trash(database) == {"jobs/x/s1"}
    (row,) = await database.fetch("SELECT reusable FROM jobs")
    assert {stage: part["prefix"] for stage, part in row["reusable"].items()} == {
        "seeding": "jobs/x/s2",
        "coarse": "jobs/x/c1",
    }


async def test_a_preview_that_was_replaced_can_be_read_for_a_while(database: Database, ledger: Ledger):
    for number in (1, 2):
        await ledger.preview(f"jobs/x/{number}", [FILE], Progress(stage="coarse", step=number))
    (row,) = await database.fetch(
        "SELECT prefix, extract(epoch FROM not_before - clock_timestamp()) AS left_s FROM trash"
    )
    assert row["prefix"] == "jobs/x/1"
    assert 30 < row["left_s"] <= ledgers.PREVIEW_KEPT_S


async def test_lines_are_numbered_on_and_the_last_that_fits_says_where_the_rest_is(
    stores: Stores, ledger: Ledger, monkeypatch: pytest.MonkeyPatch
):
    monkeypatch.setattr(ledgers, "LOG_LINES_MAX", 3)
    await ledger.log(["one", "two"])
    await ledger.log(["three", "four"])
    await ledger.log(["five"])
    lines = await stores.jobs.log(ledger.claim.job_id)
    assert [(line.n, line.text) for line in lines] == [
        (1, "one"),
        (2, "two"),
        (3, "(the rest is in log.txt alone)"),
    ]


async def test_a_flood_of_checkpoints_does_not_fill_the_history(
    stores: Stores, ledger: Ledger, monkeypatch: pytest.MonkeyPatch
):
    monkeypatch.setattr(ledgers, "EVENTS_MAX", 4)
    before = await stores.jobs.get(ledger.claim.job_id)
    for step in range(5):
        await ledger.checkpoint(f"jobs/x/{step}", ["a"], step)
    await ledger.preview("jobs/x/p", [FILE], Progress(stage="coarse"))
    await ledger.progress(Progress(stage="coarse"))
    seen = await stores.jobs.get(ledger.claim.job_id)
    assert (seen.stage, seen.revision) == ("coarse", before.revision + 8), "clients see every change"
    assert await events(stores, ledger) == ["queued", "started", "checkpoint", "checkpoint"]
    assert await ledger.publish([FILE], None)
    history = (await stores.jobs.update(ledger.claim.job_id)).events
    assert (history[-1].type, history[-1].seq) == ("succeeded", 5)


async def test_what_got_through_though_its_answer_was_lost_is_written_once(
    stores: Stores, database: Database, ledger: Ledger, monkeypatch: pytest.MonkeyPatch
):
    real, calls = database.transaction, []

    def loses_each_first_answer():
        calls.append(None)
        return _Losing(real()) if len(calls) % 2 else real()

    monkeypatch.setattr(database, "transaction", loses_each_first_answer)
    await ledger.log(["one"])
    assert await ledger.publish([FILE], "improved", ["seeding_crashed"])
    monkeypatch.undo()
    counted = [
        (tally["label"], tally["count"])
        for tally in (await stores.monitor.statistics()).tallies
        if tally["name"] == "job_faults"
    ]
    assert counted == [("seeding_crashed", 1)]
    assert [line.text for line in await stores.jobs.log(ledger.claim.job_id)] == ["one"]
    assert (await events(stores, ledger)).count("succeeded") == 1


class _Losing:
    """A transaction that commits, and then breaks."""

    def __init__(self, inner) -> None:
        self._inner = inner

    async def __aenter__(self):
        return await self._inner.__aenter__()

    async def __aexit__(self, *error):
        await self._inner.__aexit__(*error)
        if error[0] is None:
            raise Unavailable("database_unavailable", "the connection broke after the commit")


async def test_nothing_is_written_once_another_attempt_owns_the_job(database: Database, ledger: Ledger):
    assert await claimed(database, ledger.claim.job_id) is not None
    before = await database.fetch("SELECT * FROM jobs")
    for write in (
        ledger.progress(Progress(stage="coarse")),
        ledger.note_use(1.0),
        ledger.checkpoint("jobs/x/1", ["a"], 1),
        ledger.preview("jobs/x/1", [FILE], Progress(stage="coarse")),
        ledger.reusable("coarse", "jobs/x/1", ["a"]),
        ledger.log(["one"]),
        ledger.wants_partial(),
        ledger.crashes(),
        ledger.publish([FILE], None),
        ledger.fail(ERROR, []),
        ledger.cancelled([], ledger.claim.name),
        ledger.give_back(Requeue("requeued", {})),
    ):
        with pytest.raises(Fenced):
            await write
    assert await database.fetch("SELECT * FROM jobs") == before
    assert await trash(database) == set()


async def test_a_cancellation_that_came_first_outweighs_each_other_end(stores: Stores, ledger: Ledger):
    await stores.jobs.cancel(ledger.claim.job_id)
    assert not await ledger.publish([FILE], None)
    assert not await ledger.fail(ERROR, [])
    assert (await stores.jobs.get(ledger.claim.job_id)).state == "running", "the caller ends it"
    await ledger.cancelled([], ledger.claim.name)
    job = await stores.jobs.get(ledger.claim.job_id)
    assert (job.state, job.error) == ("cancelled", None)


async def test_a_job_given_back_starts_from_its_checkpoint_unless_that_is_forgotten(
    database: Database, ledger: Ledger
):
    await ledger.checkpoint("jobs/x/1", ["a"], 10)
    assert await ledger.give_back(Requeue("requeued", {"why": "shutdown"}))
    again = await claimed(database, ledger.claim.job_id)
    assert again is not None
    assert (again.attempt, again.checkpoint) == (1, {"prefix": "jobs/x/1", "files": ["a"]})
    smaller = {"max_image_size": 100}
    await Ledger(database, again, STALL_S).give_back(
        Requeue("retried_smaller", {}, "killed", forget_checkpoint=True, smaller=smaller)
    )
    last = await claimed(database, ledger.claim.job_id)
    assert last is not None
    assert (last.attempt, last.checkpoint, last.smaller) == (2, None, smaller)
