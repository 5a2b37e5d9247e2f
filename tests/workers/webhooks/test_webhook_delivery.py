"""Messages reach receivers that fail, are slow, dead or gone, whatever happens to dispatchers."""

from __future__ import annotations

import asyncio
import signal

import psycopg
import pytest
import standardwebhooks

from biresnerf.wire.webhooks import ALL_EVENTS
from tests.workers.conftest import Slots
from tests.workers.webhooks.webhook_receiver import (
    Dispatchers,
    Receiver,
    concluded,
    queued_job,
)
from workers.database.database import open_database
from workers.database.notifications import Listener
from workers.engine import Stores
from workers.settings.errors import Conflict
from workers.settings.settings import Settings
from workers.webhooks import webhooks
from workers.webhooks.outbound import Answer, Outbound, Policy
from workers.webhooks.webhook_sender import _CLAIM, WebhookSender, outcome_of, pause, retry_after

pytestmark = pytest.mark.anyio


@pytest.fixture
def many_tests(monkeypatch: pytest.MonkeyPatch) -> None:
    """Tests of webhooks are messages that need no job."""
    monkeypatch.setattr(webhooks, "TESTS_A_MINUTE", 1000)


async def test_a_failed_message_comes_again_later_and_later_under_the_same_id(
    stores: Stores, dispatchers: Dispatchers
):
    async with Receiver(b"500 No", b"429 Slow\r\nRetry-After: 1", b"408 Late", b"200 OK").open() as receiver:
        webhook, secret = await stores.webhooks.create("local", receiver.url, ALL_EVENTS)
        delivery = await stores.webhooks.test(webhook.id)
        dispatchers.start()
        messages = await receiver.heard(4)
        done = await concluded(stores, webhook.id, delivery.id)
        assert done.state == "delivered"
        assert [attempt.status for attempt in done.attempts] == [500, 429, 408, 200]
        assert {message.headers["webhook-id"] for message in messages} == {delivery.id}
        assert {message.body for message in messages} == {done.body.encode()}
        for message in messages:
            standardwebhooks.Webhook(secret).verify(message.body, message.headers)
        assert messages[2].at - messages[1].at >= 0.9, "Retry-After is kept to"
        assert (await stores.webhooks.get(webhook.id)).failing_since is None


async def test_a_refusal_ends_it_until_it_is_asked_for_again(stores: Stores, dispatchers: Dispatchers):
    async with Receiver(
        b"400 Bad", b"307 Else\r\nLocation: http://127.0.0.1:1/", b"201 Made"
    ).open() as receiver:
        webhook, _ = await stores.webhooks.create("local", receiver.url, ALL_EVENTS)
        dispatchers.start()
        delivery = await stores.webhooks.test(webhook.id)
        for count, (state, status) in enumerate([("failed", 400), ("failed", 307), ("delivered", 201)], 1):
            done = await concluded(stores, webhook.id, delivery.id)
            assert (done.state, len(done.attempts), done.attempts[-1].status) == (state, count, status)
            await stores.webhooks.redeliver(webhook.id, delivery.id)
        await receiver.heard(4)
        assert {message.headers["webhook-id"] for message in receiver.messages} == {delivery.id}


async def test_dead_receivers_hold_up_neither_jobs_nor_other_receivers(
    stores: Stores, settings: Settings, slots: Slots, dispatchers: Dispatchers, many_tests: None
):
    async with Receiver(None).open() as silent, Receiver().open() as alive:
        dead, _ = await stores.webhooks.create("local", silent.url, ALL_EVENTS)
        await stores.webhooks.create("local", "http://127.0.0.1:9/", ALL_EVENTS)
        for _ in range(60):
            await stores.webhooks.test(dead.id)
        await stores.webhooks.create("local", alive.url, ["job.succeeded"])
        dispatchers.start()
        await silent.heard(1)
        slots.start(settings, "cpu0")
        job_id = await queued_job(stores)
        (message,) = await alive.heard(1)
        assert message.data["id"] == job_id
        assert len(silent.messages) < 20, "its 60 messages do not go before"
        assert (await stores.jobs.get(job_id)).state == "succeeded"


async def test_two_dispatchers_send_each_message_once(
    stores: Stores, dispatchers: Dispatchers, many_tests: None
):
    async with Receiver().open() as receiver:
        webhook, _ = await stores.webhooks.create("local", receiver.url, ALL_EVENTS)
        ids = [(await stores.webhooks.test(webhook.id)).id for _ in range(40)]
        dispatchers.start()
        dispatchers.start_process()
        for delivery_id in ids:
            assert (await concluded(stores, webhook.id, delivery_id)).state == "delivered"
        assert sorted(message.headers["webhook-id"] for message in receiver.messages) == sorted(ids)


async def test_of_two_claims_at_one_moment_one_gets_a_message(stores: Stores, settings: Settings):
    """The second begins while the first has chosen and not committed yet."""
    webhook, _ = await stores.webhooks.create("local", "http://127.0.0.1:9/", ALL_EVENTS)
    delivery = await stores.webhooks.test(webhook.id)
    url = settings.require_database_url()
    async with open_database(url, connections=2) as database:
        listener = Listener(database, settings.poll_s, "biresnerf_webhooks")
        sender = WebhookSender(database, listener, Outbound(Policy.of(settings)), settings)
        async with await psycopg.AsyncConnection.connect(url) as first:
            claimed = await first.execute(_CLAIM, (4, 1, 30.0, 8, 32))
            assert [row[0] for row in await claimed.fetchall()] == [delivery.id]
            second = asyncio.create_task(sender._claim(32))
            await asyncio.wait([second], timeout=1.0)
        assert await second == []


async def test_sigterm_finishes_what_is_under_way_and_leaves_the_rest(
    stores: Stores, dispatchers: Dispatchers
):
    class Slow(Receiver):
        async def hear(self, reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
            await asyncio.sleep(0.5)
            await super().hear(reader, writer)

    async with Slow().open() as receiver:
        webhook, _ = await stores.webhooks.create("local", receiver.url, ALL_EVENTS)
        for _ in range(10):
            await stores.webhooks.test(webhook.id)
        process = dispatchers.start_process()
        await receiver.heard(1)
        process.send_signal(signal.SIGTERM)
        assert await asyncio.to_thread(process.wait, 10) == 0
        items = (await stores.webhooks.deliveries(webhook.id)).items
        states = [item.state for item in items]
        assert states.count("delivered") == len(receiver.messages) < 10
        assert {item.id for item in items if item.attempts} == {
            message.headers["webhook-id"] for message in receiver.messages
        }, "whatever was heard was written down"


async def test_what_a_killed_dispatcher_had_claimed_is_sent_by_the_next(
    stores: Stores, settings: Settings, dispatchers: Dispatchers
):
    async with Receiver(None, b"204 Yes").open() as receiver:
        webhook, _ = await stores.webhooks.create("local", receiver.url, ALL_EVENTS)
        delivery = await stores.webhooks.test(webhook.id)
        killed = dispatchers.start_process()
        await receiver.heard(1)
        killed.kill()
        dispatchers.start()
        await asyncio.sleep(0.3)
        assert len(receiver.messages) == 1, "the claim of the dead one holds for its time"
        with psycopg.connect(settings.require_database_url()) as connection:
            connection.execute("UPDATE webhook_deliveries SET leased_until = now()")
        done = await concluded(stores, webhook.id, delivery.id)
        assert (done.state, len(receiver.messages)) == ("delivered", 2)


@pytest.mark.parametrize("gone", [True, False])
async def test_a_receiver_that_is_gone_or_fails_for_days_is_switched_off(
    gone: bool, stores: Stores, settings: Settings, dispatchers: Dispatchers
):
    async with Receiver(b"410 Gone" if gone else b"503 No", b"204 Back").open() as receiver:
        webhook, _ = await stores.webhooks.create("local", receiver.url, ALL_EVENTS)
        if not gone:
            with psycopg.connect(settings.require_database_url()) as connection:
                connection.execute("UPDATE webhooks SET failing_since = now() - interval '6 days'")
        delivery = await stores.webhooks.test(webhook.id)
        dispatchers.start()
        assert (await concluded(stores, webhook.id, delivery.id)).state == "failed"
        off = await stores.webhooks.get(webhook.id)
        assert not off.enabled
        assert off.disabled_why == ("410 Gone" if gone else "no success in 5 days")
        with pytest.raises(Conflict):
            await stores.webhooks.test(webhook.id)
        await queued_job(stores)
        assert len((await stores.webhooks.deliveries(webhook.id)).items) == 1, "nothing is queued for it"
        on = await stores.webhooks.change(webhook.id, enabled=True)
        assert (on.enabled, on.disabled_why, on.failing_since) == (True, None, None)
        await stores.webhooks.redeliver(webhook.id, delivery.id)
        assert (await concluded(stores, webhook.id, delivery.id)).state == "delivered"


async def test_a_fault_of_ours_counts_as_an_attempt_and_ends(stores: Stores, settings: Settings):
    async def broken(host: str, port: int) -> list[str]:
        raise RuntimeError("planted")

    webhook, _ = await stores.webhooks.create("local", "http://127.0.0.1:9/", ALL_EVENTS)
    delivery = await stores.webhooks.test(webhook.id)
    with psycopg.connect(settings.require_database_url()) as connection:
        connection.execute("UPDATE webhook_deliveries SET round = 11")  # eleven failed before
    stop = asyncio.Event()
    async with open_database(settings.require_database_url(), connections=2) as database:
        listener = Listener(database, settings.poll_s, "biresnerf_webhooks")
        outbound = Outbound(Policy.of(settings), resolve=broken)
        sending = asyncio.create_task(WebhookSender(database, listener, outbound, settings).run(stop))
        done = await concluded(stores, webhook.id, delivery.id)
        stop.set()
        await sending
    assert (done.state, [attempt.error for attempt in done.attempts]) == ("failed", ["internal"])


def test_pauses_grow_from_seconds_to_half_a_day_and_scatter():
    nominal = [5, 20, 80, 320, 1280, 5120, 20480, 43200, 43200]
    for round_, expected in enumerate(nominal, 1):
        drawn = [pause(round_, 5.0) for _ in range(50)]
        assert all(0.8 * expected <= value <= 1.2 * expected for value in drawn)
        assert len(set(drawn)) > 40


def test_only_some_statuses_are_worth_another_try():
    told = {status: outcome_of(status) for status in range(100, 600)}
    assert {status for status, said in told.items() if said == "delivered"} == set(range(200, 300))
    again = {408, 409, 429, *range(500, 600)}
    assert {status for status, said in told.items() if said == "again"} == again
    assert told[410] == "gone"


@pytest.mark.parametrize(
    ("header", "seconds"),
    [(None, 0), ("", 0), ("7", 7), ("-1", 0), ("soon", 0), ("99999999", 43200), ("9" * 400, 0), ("1.5", 0)],
)
def test_retry_after_is_read_with_care(header: str | None, seconds: float):
    assert retry_after(Answer(503, {} if header is None else {"retry-after": header})) == seconds


def test_retry_after_may_be_a_date():
    for year, seconds in ((2015, 0), (2099, 43200)):
        header = {"retry-after": f"Wed, 21 Oct {year} 07:28:00 GMT"}
        assert retry_after(Answer(503, header)) == seconds
