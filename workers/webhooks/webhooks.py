"""Webhooks as their owners see them: create, change, delete, test, list deliveries, send again.

Triggers of the schema put messages into the outbox in the transaction of the reported change;
`workers.webhooks.webhook_sender` sends them.
"""

from __future__ import annotations

import json
from collections.abc import Sequence
from datetime import UTC, datetime
from typing import Any

from biresnerf.wire.base import Page
from biresnerf.wire.webhooks import BatchWebhook, DeliveryView, WebhookEvent, WebhookView, new_secret
from workers.database.database import Connection, Database, OwnedStore
from workers.database.ids import new_id
from workers.records import NEWEST_FIRST, newest_first, page_of, record_from_row
from workers.settings.errors import Conflict, LimitReached
from workers.settings.settings import Settings
from workers.webhooks.outbound import Policy, checked_url

ROTATION_HOURS = 24
TEST_EVENT = "webhook.test"
TESTS_A_MINUTE = 10
_MINE = "tenant = coalesce(%s, tenant)"
_DELIVERY = """
    SELECT webhook_deliveries.*, (SELECT coalesce(jsonb_agg(to_jsonb(attempt) - 'delivery_id' ORDER BY number), '[]')
        FROM webhook_attempts AS attempt WHERE attempt.delivery_id = webhook_deliveries.id) AS log
    FROM webhook_deliveries"""


class WebhookStore(OwnedStore):
    """Webhooks in the database. Get one from `workers.engine.open_stores`.

    Every method raises `Unavailable` if the database does not answer.
    """

    def __init__(self, database: Database, settings: Settings) -> None:
        super().__init__(database)
        self._settings = settings

    async def create(
        self, tenant: str, url: str, events: Sequence[WebhookEvent], description: str = ""
    ) -> tuple[WebhookView, str]:
        """A new webhook and its secret.

        Raises `InputError` (``webhook_url_refused``), `LimitReached` (``too_many_webhooks``).
        """
        target = str(checked_url(url, Policy.of(self._settings)))
        secret = new_secret()
        async with self._database.transaction() as connection:
            await connection.execute("SELECT 1 FROM tenants WHERE id = %s FOR NO KEY UPDATE", (tenant,))
            have = "SELECT count(*) FROM webhooks WHERE tenant = %s AND coalesce(job_id, batch_id) IS NULL"
            if await connection.value(have, tenant) >= self._settings.max_webhooks:
                raise LimitReached(
                    "too_many_webhooks", f"There are {self._settings.max_webhooks} webhooks already."
                )
            row = await connection.only_row(
                "INSERT INTO webhooks (id, tenant, url, events, description, secret)"
                " VALUES (%s, %s, %s, %s, %s, %s) RETURNING *",
                *(new_id("wh"), tenant, target, list(dict.fromkeys(events)), description, secret),
            )
            return _webhook(row), secret

    async def get(self, webhook_id: str) -> WebhookView:
        """The webhook; raises `NotFound`."""
        async with self._database.transaction() as connection:
            return _webhook(await self._required(connection, webhook_id))

    async def list(
        self, *, job_id: str | None = None, limit: int = 50, cursor: str | None = None
    ) -> Page[WebhookView]:
        """Webhooks, newest first: those for all jobs, or those of one job or batch.

        Raises `InputError` (``bad_cursor``).
        """
        rows = await self._database.fetch(
            f"SELECT * FROM webhooks WHERE {_MINE} AND coalesce(job_id, batch_id) IS NOT DISTINCT FROM %s"
            + NEWEST_FIRST,
            *(self._tenant, job_id, *newest_first(cursor, limit)),
        )
        return page_of(map(_webhook, rows), limit)

    async def change(
        self,
        webhook_id: str,
        *,
        url: str | None = None,
        events: Sequence[WebhookEvent] | None = None,
        description: str | None = None,
        enabled: bool | None = None,
    ) -> WebhookView:
        """Change the given fields. Enabling it clears its failures; disabling it drops waiting messages.

        Raises `NotFound`, `InputError` (``webhook_url_refused``).
        """
        target = None if url is None else str(checked_url(url, Policy.of(self._settings)))
        async with self._database.transaction() as connection:
            await self._required(connection, webhook_id, lock=True)
            row = await connection.only_row(
                "UPDATE webhooks SET url = coalesce(%s, url), events = coalesce(%s, events),"
                " description = coalesce(%s, description), enabled = coalesce(%s, enabled),"
                " disabled_why = CASE WHEN %s::boolean IS NULL THEN disabled_why END,"
                " failing_since = CASE WHEN %s THEN NULL ELSE failing_since END WHERE id = %s RETURNING *",
                *(target, None if events is None else list(dict.fromkeys(events)), description),
                *(enabled, enabled, enabled is True, webhook_id),
            )
            if enabled is False:
                await drop_pending(connection, webhook_id)
            return _webhook(row)

    async def rotate(self, webhook_id: str) -> tuple[WebhookView, str]:
        """A new secret; for a day, messages are signed with both. Raises `NotFound`."""
        secret = new_secret()
        async with self._database.transaction() as connection:
            await self._required(connection, webhook_id, lock=True)
            row = await connection.only_row(
                "UPDATE webhooks SET previous_secret = secret, secret = %s,"
                " previous_until = clock_timestamp() + make_interval(hours => %s) WHERE id = %s RETURNING *",
                *(secret, ROTATION_HOURS, webhook_id),
            )
            return _webhook(row), secret

    async def delete(self, webhook_id: str) -> None:
        """Delete it with its deliveries; waiting messages are not sent. Raises `NotFound`."""
        sql = f"DELETE FROM webhooks WHERE id = %s AND {_MINE} RETURNING id"
        async with self._database.transaction() as connection:
            await connection.required_row(f"No webhook {webhook_id}.", sql, webhook_id, self._tenant)

    async def test(self, webhook_id: str) -> DeliveryView:
        """Queue a message ``webhook.test``.

        Raises `NotFound`, `Conflict` (``state_conflict``), `LimitReached` (``rate_limited``).
        """
        delivery_id = new_id("msg")
        message = {
            "type": TEST_EVENT,
            "timestamp": datetime.now(UTC).isoformat().replace("+00:00", "Z"),
            "data": {"webhook_id": webhook_id},
        }
        async with self._database.transaction() as connection:
            await self._require_enabled(connection, webhook_id)
            recent = (
                "SELECT count(*) FROM webhook_deliveries WHERE webhook_id = %s AND event = %s"
                " AND created_at > clock_timestamp() - interval '1 minute'"
            )
            if await connection.value(recent, webhook_id, TEST_EVENT) >= TESTS_A_MINUTE:
                raise LimitReached(
                    "rate_limited", f"A webhook is tested {TESTS_A_MINUTE} times a minute at most."
                )
            await connection.execute(
                "INSERT INTO webhook_deliveries (id, webhook_id, event, body) VALUES (%s, %s, %s, %s)",
                (delivery_id, webhook_id, TEST_EVENT, json.dumps(message)),
            )
            await connection.execute("SELECT pg_notify('biresnerf_webhooks', '')")
            return await _delivery(connection, webhook_id, delivery_id)

    async def deliveries(
        self, webhook_id: str, *, limit: int = 50, cursor: str | None = None
    ) -> Page[DeliveryView]:
        """Messages sent and waiting, newest first; raises `NotFound`, `InputError` (``bad_cursor``)."""
        place = newest_first(cursor, limit)
        async with self._database.transaction() as connection:
            await self._required(connection, webhook_id)
            sql = _DELIVERY + " WHERE webhook_id = %s" + NEWEST_FIRST
            rows = await connection.rows(sql, webhook_id, *place)
        return page_of(map(_delivery_record, rows), limit)

    async def delivery(self, webhook_id: str, delivery_id: str) -> DeliveryView:
        """One message; raises `NotFound`."""
        async with self._database.transaction() as connection:
            await self._required(connection, webhook_id)
            return await _delivery(connection, webhook_id, delivery_id)

    async def redeliver(self, webhook_id: str, delivery_id: str) -> DeliveryView:
        """Send a message again at once, with the same id and a fresh count of attempts.

        A waiting one is sent at once; one that is being sent arrives twice.
        Raises `NotFound`, `Conflict` (``state_conflict``).
        """
        async with self._database.transaction() as connection:
            await self._require_enabled(connection, webhook_id)
            await _delivery(connection, webhook_id, delivery_id)
            await connection.execute(
                "UPDATE webhook_deliveries SET state = 'pending', round = 0, due_at = clock_timestamp(),"
                " leased_until = NULL, finished_at = NULL WHERE id = %s",
                (delivery_id,),
            )
            await connection.execute("SELECT pg_notify('biresnerf_webhooks', '')")
            return await _delivery(connection, webhook_id, delivery_id)

    async def _require_enabled(self, connection: Connection, webhook_id: str) -> None:
        row = await self._required(connection, webhook_id, lock=True)
        if not row["enabled"]:
            raise Conflict("state_conflict", f"Webhook {webhook_id} is switched off; switch it on first.")

    async def _required(
        self, connection: Connection, webhook_id: str, *, lock: bool = False
    ) -> dict[str, Any]:
        end = " FOR NO KEY UPDATE" if lock else ""
        sql = f"SELECT * FROM webhooks WHERE id = %s AND {_MINE}{end}".encode()
        return await connection.required_row(f"No webhook {webhook_id}.", sql, webhook_id, self._tenant)


async def add_webhook(
    connection: Connection,
    settings: Settings,
    tenant: str,
    wanted: BatchWebhook,
    events: Sequence[WebhookEvent],
    *,
    job_id: str | None = None,
    batch_id: str | None = None,
) -> None:
    """Create the webhook of one job or batch, in the transaction that creates that and before its first event.

    Raises `InputError` (``webhook_url_refused``).
    """
    target = str(checked_url(wanted.url, Policy.of(settings)))
    await connection.execute(
        "INSERT INTO webhooks (id, tenant, job_id, batch_id, url, events, secret)"
        " VALUES (%s, %s, %s, %s, %s, %s, %s)",
        (new_id("wh"), tenant, job_id, batch_id, target, list(dict.fromkeys(events)), wanted.secret),
    )


async def drop_pending(connection: Connection, webhook_id: str) -> None:
    """Mark the waiting messages of a disabled webhook as failed."""
    await connection.execute(
        "UPDATE webhook_deliveries SET state = 'failed', finished_at = clock_timestamp()"
        " WHERE webhook_id = %s AND state = 'pending'",
        (webhook_id,),
    )


async def _delivery(connection: Connection, webhook_id: str, delivery_id: str) -> DeliveryView:
    missing = f"Webhook {webhook_id} has no delivery {delivery_id}."
    sql = _DELIVERY + " WHERE id = %s AND webhook_id = %s"
    return _delivery_record(await connection.required_row(missing, sql, delivery_id, webhook_id))


def _webhook(row: dict[str, Any]) -> WebhookView:
    rotating = row["previous_until"] is not None and row["previous_until"] > datetime.now(UTC)
    return record_from_row(
        WebhookView, row, previous_secret_until=row["previous_until"] if rotating else None
    )


def _delivery_record(row: dict[str, Any]) -> DeliveryView:
    waits = row["state"] == "pending"
    return record_from_row(
        DeliveryView, row, next_attempt_at=row["due_at"] if waits else None, attempts=row["log"]
    )
