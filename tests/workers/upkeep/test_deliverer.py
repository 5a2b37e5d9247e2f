"""Files of jobs reach their owners' addresses; failures are recorded in the job, which is otherwise unchanged."""

from __future__ import annotations

import asyncio
import hashlib
import io
import json
import time
import uuid
import zipfile
from pathlib import Path

import psycopg
import pytest

from biresnerf.errors import InputError
from biresnerf.options.refine_options import RefineOptions
from biresnerf.wire.deliveries import DeliveredFile, DeliverTo
from biresnerf.wire.jobs import JobView
from tests.workers.conftest import Slots, ready_dataset
from tests.workers.webhooks.conftest import dispatchers, settings
from tests.workers.webhooks.webhook_receiver import PATIENCE_S, Dispatchers, Receiver
from workers.database.losses import LOSSES_MAX
from workers.engine import Stores
from workers.records import Artifact
from workers.settings.errors import Conflict
from workers.settings.settings import Settings
from workers.upkeep.deliverer import zip_bytes, zipped

__all__ = ["dispatchers", "settings"]
pytestmark = pytest.mark.anyio
SECRET = "?X-Amz-Signature=SECRETSIGNATURE"


async def submitted(stores: Stores, deliver: DeliverTo | None, key: str | None = None) -> JobView:
    plan = {"steps": 3, "step_s": 0.01, "journal": "/dev/null"}
    dataset_id = await ready_dataset(stores, {"plan.json": json.dumps(plan).encode()})
    options = RefineOptions(preset="fast")
    return (await stores.jobs.submit(dataset_id, options, deliver=deliver, idempotency_key=key))[0]


async def over(stores: Stores, job: JobView) -> dict[str | None, DeliveredFile]:
    """What became of each file, once it is known of all."""
    end = time.monotonic() + PATIENCE_S + 20
    while True:
        now = await stores.jobs.get(job.id)
        if now.final and all(item.state != "waiting" for item in now.delivered):
            return {item.name: item for item in now.delivered}
        assert time.monotonic() < end, now
        await asyncio.sleep(0.05)


async def addresses(stores: Stores) -> int:
    return len(await stores.uploads._database.fetch("SELECT 1 FROM job_deliveries"))


async def test_a_zip_and_single_files_arrive_as_they_are_once_the_job_is_over(
    stores: Stores, settings: Settings, slots: Slots, dispatchers: Dispatchers
):
    async with Receiver().open() as whole, Receiver().open() as single:
        to = DeliverTo(archive=whole.url + SECRET, files={"report.json": single.url + SECRET})
        job = await submitted(stores, to)
        assert {item.state for item in job.delivered} == {"waiting"}
        dispatchers.start()
        await asyncio.sleep(0.5)
        assert whole.messages == single.messages == [], "the job is not over"
        slots.start(settings, "cpu0")
        done = await over(stores, job)
        assert {(item.state, item.host, item.error) for item in done.values()} == {
            ("delivered", "127.0.0.1", None)
        }
        artifacts = {item.name: item for item in await stores.jobs.artifacts(job.id)}
        with zipfile.ZipFile(io.BytesIO(whole.messages[0].body)) as archive:
            assert archive.testzip() is None
            found = {name: hashlib.sha256(archive.read(name)).hexdigest() for name in archive.namelist()}
        assert found == {name: item.sha256 for name, item in artifacts.items()}
        assert hashlib.sha256(single.messages[0].body).hexdigest() == artifacts["report.json"].sha256
        assert single.messages[0].headers["content-type"] == "application/json"
        assert (len(whole.messages), len(single.messages), await addresses(stores)) == (1, 1, 0)
        assert (await stores.jobs.get(job.id)).state == "succeeded"


async def test_what_fails_is_said_and_goes_to_new_addresses_when_asked_again(
    stores: Stores, settings: Settings, slots: Slots, dispatchers: Dispatchers
):
    async with (
        Receiver(b"403 Forbidden").open() as expired,
        Receiver(b"307 T\r\nLocation: http://127.0.0.1:9/").open() as moved,
        Receiver(b"503 Busy", b"429 Wait", b"200 OK").open() as busy,
    ):
        files = {"report.json": moved.url + SECRET, "log.txt": busy.url + SECRET, "none.json": busy.url}
        job = await submitted(stores, DeliverTo(archive=expired.url + SECRET, files=files))
        dispatchers.start()
        slots.start(settings, "cpu0")
        done = await over(stores, job)
        assert "answers 403; a signed address may have expired" in done[None].error.detail
        assert done["report.json"].error.detail == "127.0.0.1 answers 307."
        assert (done["none.json"].error.code, done["none.json"].error.where) == ("not_found", "none.json")
        assert (done["log.txt"].state, len(busy.messages)) == ("delivered", 3)
        assert (len(expired.messages), len(moved.messages)) == (1, 1)
        assert (await stores.jobs.get(job.id)).state == "succeeded"
        again = await stores.jobs.deliver(job.id, DeliverTo(archive=busy.url + SECRET))
        assert len(again.delivered) == 4
        assert again.revision > job.revision
        done = await over(stores, job)
        assert (done[None].state, done[None].error) == ("delivered", None)
        assert done["report.json"].state == "failed"
        shown = (await stores.jobs.get(job.id)).model_dump_json()
        assert "SECRET" not in shown + str(done)
        assert await addresses(stores) == 0


async def test_a_job_that_never_ran_sends_no_empty_zip_but_says_that_it_has_no_files(
    stores: Stores, settings: Settings, dispatchers: Dispatchers
):
    async with Receiver().open() as receiver:
        job = await submitted(stores, DeliverTo(archive=receiver.url, files={"log.txt": receiver.url}))
        dispatchers.start()
        await stores.jobs.cancel(job.id)
        for item in (await over(stores, job)).values():
            assert item.error is not None
            assert (item.state, item.error.code) == ("failed", "not_found")
            assert "The job has no files." in item.error.detail
        assert receiver.messages == []


@pytest.mark.parametrize("url", ["http://10.0.0.1/a", "http://169.254.169.254/a", "gopher://127.0.0.1/a"])
async def test_an_address_inside_is_refused_with_the_job(stores: Stores, url: str):
    with pytest.raises(InputError) as told:
        await submitted(stores, DeliverTo(files={"report.json": url}))
    assert (told.value.code, told.value.where) == ("address_refused", "report.json")
    assert await addresses(stores) == 0
    job = await submitted(stores, None)
    with pytest.raises(InputError):
        await stores.jobs.deliver(job.id, DeliverTo(archive=url))
    assert (await stores.jobs.get(job.id)).delivered == ()


async def test_a_name_that_leads_inside_gets_nothing(
    stores: Stores, settings: Settings, slots: Slots, dispatchers: Dispatchers
):
    async with Receiver().open() as receiver:
        job = await submitted(stores, DeliverTo(archive=receiver.url))
        dispatchers.start(settings.model_copy(update={"file_address_networks": ()}))
        slots.start(settings, "cpu0")
        assert (await over(stores, job))[None].error.code == "address_refused"
        assert receiver.messages == []


async def test_a_repeated_request_with_other_addresses_is_the_same_job_and_keeps_the_first(stores: Stores):
    first = await submitted(stores, DeliverTo(archive="http://127.0.0.1:9/a"), "key")
    dataset, options = first.dataset_id, RefineOptions(preset="fast")
    other = DeliverTo(archive="http://127.0.0.1:9/b")
    same, new = await stores.jobs.submit(dataset, options, deliver=other, idempotency_key="key")
    assert (same.id, new) == (first.id, False)
    rows = await stores.uploads._database.fetch("SELECT url FROM job_deliveries")
    assert [row["url"] for row in rows] == ["http://127.0.0.1:9/a"]


async def test_what_a_killed_dispatcher_was_sending_is_sent_by_the_next_and_losses_in_a_row_end_it(
    stores: Stores, settings: Settings, slots: Slots, dispatchers: Dispatchers
):
    async with Receiver(None, b"200 OK").open() as receiver:
        job = await submitted(stores, DeliverTo(archive=receiver.url))
        slots.start(settings, "cpu0")
        killed = dispatchers.start_process()
        await receiver.heard(1)
        killed.kill()
        dispatchers.start()
        assert (await over(stores, job))[None].state == "delivered"
        assert len(receiver.messages) == 2
        await stores.jobs.deliver(job.id, DeliverTo(files={"log.txt": receiver.url}))
        with psycopg.connect(settings.require_database_url()) as connection:
            lost = "UPDATE job_deliveries SET token = %s, leased_until = now(), losses = %s, due_at = now()"
            connection.execute(lost, (uuid.uuid4(), LOSSES_MAX - 1))
        said = (await over(stores, job))["log.txt"].error
        assert (said.code, len(receiver.messages)) == ("delivery_failed", 2)


async def test_a_try_that_fails_and_costs_no_process_ends_the_count_of_losses(
    stores: Stores, settings: Settings, slots: Slots, dispatchers: Dispatchers
):
    database = stores.uploads._database
    async with Receiver(b"503 Busy", b"200 OK").open() as receiver:
        job = await submitted(stores, DeliverTo(archive=receiver.url))
        await database.fetch("UPDATE job_deliveries SET losses = %s", LOSSES_MAX - 1)
        dispatchers.start()
        slots.start(settings, "cpu0")
        seen = set()
        while rows := await database.fetch("SELECT losses FROM job_deliveries"):
            seen |= {row["losses"] for row in rows}
            await asyncio.sleep(0.01)
        assert (await over(stores, job))[None].state == "delivered"
    assert seen == {LOSSES_MAX - 1, 0}


async def test_a_deleted_job_sends_nothing_and_an_export_has_no_files_of_its_own(
    stores: Stores, settings: Settings, dispatchers: Dispatchers
):
    async with Receiver().open() as receiver:
        job = await submitted(stores, DeliverTo(archive=receiver.url))
        await stores.jobs.cancel(job.id)
        await stores.jobs.delete(job.id)
        dispatchers.start()
        await asyncio.sleep(0.5)
        assert (receiver.messages, await addresses(stores)) == ([], 0)
        other = await submitted(stores, None)
        with psycopg.connect(settings.require_database_url()) as connection:
            connection.execute("UPDATE jobs SET kind = 'export' WHERE id = %s", (other.id,))
        with pytest.raises(Conflict):
            await stores.jobs.deliver(other.id, DeliverTo(archive=receiver.url))


async def test_the_size_of_a_zip_is_known_before_it_is_made(stores: Stores, tmp_path: Path):
    artifacts = []
    for name, content in {"a/é.png": bytes(3_000_000), "empty": b"", "report.json": b"{}"}.items():
        stored = await stores.files.put_bytes(f"some/{name}", content)
        artifacts.append(Artifact(name=name, key=stored.key, size=len(content), sha256="", media_type="a/b"))
    for some in (artifacts, artifacts[:1], []):
        made = b"".join([chunk async for chunk in zipped(stores.files, some)])
        assert len(made) == zip_bytes(some)
        with zipfile.ZipFile(io.BytesIO(made)) as archive:
            assert archive.testzip() is None
            assert {info.filename: info.file_size for info in archive.infolist()} == {
                item.name: item.size for item in some
            }
