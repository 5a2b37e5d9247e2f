"""Which messages webhooks get, from whom, and how they are signed; an independent library checks the signatures."""

from __future__ import annotations

import asyncio
import time
from datetime import UTC, datetime

import psycopg
import pytest
import standardwebhooks

from biresnerf.wire.webhooks import ALL_EVENTS, new_secret
from tests.workers.conftest import Slots
from tests.workers.webhooks.webhook_receiver import (
    Dispatchers,
    Receiver,
    concluded,
    queued_job,
)
from workers.database.database import Database, open_database
from workers.engine import Stores
from workers.settings.errors import LimitReached, NotFound
from workers.settings.settings import Settings
from workers.webhooks.webhook_sender import Result, WebhookSender, signed_headers

pytestmark = pytest.mark.anyio


async def test_a_jobs_life_is_told_signed_and_an_independent_reader_believes_it(
    stores: Stores, settings: Settings, slots: Slots, dispatchers: Dispatchers
):
    async with Receiver().open() as receiver:
        webhook, secret = await stores.webhooks.create("local", receiver.url, ALL_EVENTS)
        dispatchers.start()
        slots.start(settings, "cpu0")
        job_id = await queued_job(stores)
        messages = await receiver.heard(4)
        assert sorted(receiver.events()) == [
            "dataset.validated",
            "job.queued",
            "job.started",
            "job.succeeded",
        ]
        for message in messages:
            told = standardwebhooks.Webhook(secret).verify(message.body, message.headers)
            assert told["timestamp"].endswith("Z")
            assert message.headers["content-type"] == "application/json"
            with pytest.raises(standardwebhooks.WebhookVerificationError):
                standardwebhooks.Webhook(secret).verify(message.body + b" ", message.headers)
        by_event = dict(zip(receiver.events(), messages, strict=True))
        assert by_event["dataset.validated"].data["state"] == "ready"
        end = by_event["job.succeeded"].data
        job = await stores.jobs.get(job_id)
        assert (end["id"], end["state"], end["attempt"]) == (job_id, "succeeded", 1)
        assert (end["labels"], end["verdict"]) == ({"run": "ä"}, job.verdict)
        assert by_event["job.queued"].data["state"] == "queued"
        page = await stores.webhooks.deliveries(webhook.id)
        assert {item.id for item in page.items} == {m.headers["webhook-id"] for m in messages}
        last = await concluded(stores, webhook.id, by_event["job.succeeded"].headers["webhook-id"])
        assert [(a.number, a.status, a.error) for a in last.attempts] == [(1, 204, None)]


async def test_a_message_that_somebody_caught_is_of_no_use_later_or_as_another(
    stores: Stores, dispatchers: Dispatchers
):
    async with Receiver().open() as receiver:
        webhook, secret = await stores.webhooks.create("local", receiver.url, ALL_EVENTS)
        dispatchers.start()
        await stores.webhooks.test(webhook.id)
        (caught,) = await receiver.heard(1)
    reader, now = standardwebhooks.Webhook(secret), int(time.time())
    assert reader.verify(caught.body, caught.headers)["type"] == "webhook.test"
    for name, value in (("webhook-timestamp", str(now + 1)), ("webhook-id", "msg_other")):
        assert caught.headers[name] != value
        with pytest.raises(standardwebhooks.WebhookVerificationError, match="No matching signature"):
            reader.verify(caught.body, {**caught.headers, name: value})
    old = signed_headers(caught.headers["webhook-id"], now - 6 * 60, caught.body, [secret])
    with pytest.raises(standardwebhooks.WebhookVerificationError, match="too old"):
        reader.verify(caught.body, old)


def test_while_a_secret_is_rotated_holders_of_the_old_and_of_the_new_one_believe_a_message_and_nobody_else():
    old, new, other = (new_secret() for _ in range(3))
    body, at = b'{"type": "job.succeeded"}', int(time.time())
    headers = signed_headers("msg_1", at, body, [new, old])
    for secret in (old, new):
        assert standardwebhooks.Webhook(secret).verify(body, headers) == {"type": "job.succeeded"}
        for changed in ({"webhook-id": "msg_2"}, {"webhook-timestamp": str(at - 1)}):
            with pytest.raises(standardwebhooks.WebhookVerificationError):
                standardwebhooks.Webhook(secret).verify(body, headers | changed)
    with pytest.raises(standardwebhooks.WebhookVerificationError):
        standardwebhooks.Webhook(other).verify(body, headers)


async def test_only_what_was_asked_for_comes_and_only_to_its_tenant(
    stores: Stores, settings: Settings, dispatchers: Dispatchers
):
    with psycopg.connect(settings.require_database_url()) as connection:
        connection.execute("INSERT INTO tenants (id) VALUES ('other')")
    async with Receiver().open() as mine, Receiver().open() as other:
        await stores.webhooks.create("local", mine.url, ["job.cancelled"])
        foreign, _ = await stores.webhooks.create("other", other.url, ALL_EVENTS)
        job_id = await queued_job(stores)
        await stores.jobs.cancel(job_id)
        dispatchers.start()
        (message,) = await mine.heard(1)
        assert (message.data["id"], message.data["state"]) == (job_id, "cancelled")
        assert other.messages == []
        assert (await stores.webhooks.deliveries(foreign.id)).items == ()
        local = stores.webhooks.for_tenant("local")
        for call in (local.get, local.delete, local.test, local.rotate, local.deliveries, local.change):
            with pytest.raises(NotFound):
                await call(foreign.id)
        assert [item.tenant for item in (await local.list()).items] == ["local"]


async def test_a_change_that_is_rolled_back_is_told_to_nobody(stores: Stores, settings: Settings):
    webhook, _ = await stores.webhooks.create("local", "http://127.0.0.1:9999/", ALL_EVENTS)
    job_id = await queued_job(stores)
    before = (await stores.webhooks.deliveries(webhook.id)).items
    with psycopg.connect(settings.require_database_url()) as connection:
        connection.execute("SELECT add_job_event(%s, 'failed', '{}')", (job_id,))
        connection.rollback()
    assert (await stores.webhooks.deliveries(webhook.id)).items == before
    with psycopg.connect(settings.require_database_url()) as connection:
        connection.execute("SELECT add_job_event(%s, 'failed', '{}')", (job_id,))
    assert len((await stores.webhooks.deliveries(webhook.id)).items) == len(before) + 1


async def test_after_a_rotation_both_secrets_are_good_and_later_the_new_one_alone(
    stores: Stores, settings: Settings, dispatchers: Dispatchers
):
    async with Receiver().open() as receiver:
        webhook, old = await stores.webhooks.create("local", receiver.url, ALL_EVENTS)
        changed, new = await stores.webhooks.rotate(webhook.id)
        assert changed.previous_secret_until is not None
        dispatchers.start()
        await stores.webhooks.test(webhook.id)
        (message,) = await receiver.heard(1)
        for secret in (old, new):
            standardwebhooks.Webhook(secret).verify(message.body, message.headers)
        with psycopg.connect(settings.require_database_url()) as connection:
            connection.execute("UPDATE webhooks SET previous_until = now() - interval '1 second'")
        await stores.webhooks.test(webhook.id)
        later = (await receiver.heard(2))[1]
        standardwebhooks.Webhook(new).verify(later.body, later.headers)
        with pytest.raises(standardwebhooks.WebhookVerificationError):
            standardwebhooks.Webhook(old).verify(later.body, later.headers)
        assert (await stores.webhooks.get(webhook.id)).previous_secret_until is None


async def test_an_inside_address_is_not_sent_to_whatever_the_row_says(
    stores: Stores, settings: Settings, dispatchers: Dispatchers
):
    async with Receiver().open() as receiver:
        webhook, _ = await stores.webhooks.create("local", receiver.url, ALL_EVENTS)
        delivery = await stores.webhooks.test(webhook.id)
        strict = settings.model_copy(update={"webhook_networks": ()})
        dispatchers.start(strict)
        done = await concluded(stores, webhook.id, delivery.id)
        assert (done.state, [a.error for a in done.attempts]) == ("failed", ["url_refused"])
        assert receiver.messages == []


async def test_a_tenant_has_so_many_webhooks_and_no_more(settings: Settings, stores: Stores):
    few = settings.model_copy(update={"max_webhooks": 2})
    async with open_database(settings.require_database_url(), connections=2) as database:
        store = type(stores.webhooks)(database, few).for_tenant("local")
        for _ in range(2):
            await store.create("local", "http://127.0.0.1:9999/", ["job.failed"])
        with pytest.raises(LimitReached) as told:
            await store.create("local", "http://127.0.0.1:9999/", ["job.failed"])
        assert told.value.code == "too_many_webhooks"


async def waiting_for_locks(database: Database, count: int) -> None:
    sql = "SELECT count(*) AS n FROM pg_stat_activity WHERE wait_event_type = 'Lock' AND pid <> pg_backend_pid()"
    async with asyncio.timeout(30):
        while (await database.fetch(sql))[0]["n"] < count:
            await asyncio.sleep(0.05)


async def test_a_webhook_is_deleted_while_the_outcome_of_its_message_is_written_down(
    stores: Stores, settings: Settings
):
    webhook, _ = await stores.webhooks.create("local", "http://127.0.0.1:9/in", ALL_EVENTS)
    await stores.webhooks.test(webhook.id)
    async with open_database(settings.require_database_url()) as database:
        sender = WebhookSender(database, None, None, settings)  # type: ignore[arg-type]
        (row,) = await sender._claim(1)
        failed = Result("again", error="connection_failed")

        async def conclude() -> None:
            async with database.transaction() as connection:
                await sender._conclude(connection, row, failed, datetime.now(UTC), 0.1)

        async with database.transaction() as holder:
            # The outcome is half written down when the deletion begins.
            await holder.execute("LOCK TABLE webhook_attempts IN EXCLUSIVE MODE")
            concluding = asyncio.create_task(conclude())
            await waiting_for_locks(database, 1)
            deleting = asyncio.create_task(stores.webhooks.delete(webhook.id))
            await waiting_for_locks(database, 2)
        assert await asyncio.gather(concluding, deleting, return_exceptions=True) == [None, None]
        with pytest.raises(NotFound):
            await stores.webhooks.get(webhook.id)
        await conclude()  # of what is deleted by now


async def test_behind_a_thousand_messages_that_wait_others_fail_at_once_and_can_be_sent_again(
    stores: Stores, settings: Settings
):
    webhook, _ = await stores.webhooks.create("local", "http://127.0.0.1:9/in", ALL_EVENTS)
    other, _ = await stores.webhooks.create("local", "http://127.0.0.1:9/other", ALL_EVENTS)
    with psycopg.connect(settings.require_database_url()) as connection:
        connection.execute(
            "INSERT INTO webhook_deliveries (id, webhook_id, event, body)"
            " SELECT 'msg_' || n, %s, 'job.queued', '{}' FROM generate_series(1, 999) AS n",
            (webhook.id,),
        )
    await queued_job(stores)
    newest = (await stores.webhooks.deliveries(webhook.id, limit=2)).items
    assert {(one.event, one.state) for one in newest} == {
        ("dataset.validated", "pending"),
        ("job.queued", "failed"),
    }
    (late,) = [one for one in newest if one.state == "failed"]
    assert (late.attempts, late.next_attempt_at) == ((), None)
    assert {one.state for one in (await stores.webhooks.deliveries(other.id)).items} == {"pending"}
    assert (await stores.webhooks.redeliver(webhook.id, late.id)).state == "pending"


async def test_a_webhook_is_tested_ten_times_a_minute_at_most(stores: Stores):
    webhook, _ = await stores.webhooks.create("local", "http://127.0.0.1:9/in", ALL_EVENTS)
    other, _ = await stores.webhooks.create("local", "http://127.0.0.1:9/other", ALL_EVENTS)
    for _ in range(10):
        await stores.webhooks.test(webhook.id)
    with pytest.raises(LimitReached) as caught:
        await stores.webhooks.test(webhook.id)
    assert caught.value.code == "rate_limited"
    await stores.webhooks.test(other.id)
