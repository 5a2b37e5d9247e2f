"""Sends the messages in the outbox: each is claimed by one process, signed, posted, and recorded.

A claim is a lease, so no transaction waits for a receiver, and messages of a killed process are sent again once the
lease expires. Delivery is at least once; retries keep the message's id.
"""

from __future__ import annotations

import base64
import hashlib
import hmac
import logging
import random
import time
from collections.abc import Sequence
from dataclasses import dataclass
from datetime import UTC, datetime
from typing import Any, Literal

import psycopg

from biresnerf import __version__
from biresnerf.wire.retry_after import retry_after_s
from biresnerf.wire.webhooks import key_of
from workers.database.claimed_work import ClaimedWork
from workers.database.database import Connection, Database
from workers.database.notifications import Listener
from workers.settings.errors import Unavailable
from workers.settings.settings import Settings
from workers.webhooks.outbound import TROUBLES, Answer, Outbound, trouble_of
from workers.webhooks.webhooks import drop_pending

log = logging.getLogger(__name__)

# Concurrent messages: per process, per receiver, per receiver that failed last time, per tenant.
IN_FLIGHT_MAX = 32
PER_WEBHOOK, PER_FAILING, PER_TENANT = 4, 1, 8
ROUNDS_MAX = 12
PAUSE_FACTOR, PAUSE_MAX_S = 4.0, 12 * 3600.0
JITTER = 0.2
# Lease beyond the longest delivery: time to record the outcome.
LEASE_SPARE_S = 30.0
AGAIN = {408, 409, 429}
Outcome = Literal["delivered", "again", "failed", "gone"]
_CLAIM = """
    WITH waiting AS (
        SELECT delivery.id, delivery.due_at, hook.tenant, hook.failing_since, delivery.leased_until > now() AS busy,
            row_number() OVER (PARTITION BY hook.id
                ORDER BY delivery.leased_until > now() DESC NULLS LAST, delivery.due_at) AS of_webhook
        FROM webhook_deliveries AS delivery JOIN webhooks AS hook ON hook.id = delivery.webhook_id
        WHERE delivery.state = 'pending' AND (delivery.due_at <= now() OR delivery.leased_until > now())
    ), fair AS (
        SELECT id, due_at, busy, row_number() OVER (PARTITION BY tenant
            ORDER BY busy DESC NULLS LAST, due_at) AS of_tenant
        FROM waiting WHERE of_webhook <= CASE WHEN failing_since IS NULL THEN %s ELSE %s END
    )
    UPDATE webhook_deliveries AS delivery SET leased_until = now() + make_interval(secs => %s)
    FROM webhooks AS hook WHERE hook.id = delivery.webhook_id AND delivery.id IN (
        SELECT free.id FROM webhook_deliveries AS free WHERE free.id IN (
            SELECT id FROM fair WHERE busy IS NOT TRUE AND of_tenant <= %s ORDER BY due_at LIMIT %s)
        AND free.state = 'pending' AND free.due_at <= now()
        AND (free.leased_until > now()) IS NOT TRUE FOR UPDATE SKIP LOCKED)
    RETURNING delivery.id, delivery.round, delivery.leased_until, delivery.body, hook.id AS webhook_id, hook.url,
        hook.secret, CASE WHEN hook.previous_until > now() THEN hook.previous_secret END AS previous"""


@dataclass(frozen=True)
class Result:
    """The result of one attempt."""

    outcome: Outcome
    status: int | None = None
    error: str | None = None
    retry_after_s: float = 0.0


class WebhookSender(ClaimedWork):
    """Runs in every dispatcher; several may. At shutdown it finishes what is under way."""

    at_once = IN_FLIGHT_MAX

    def __init__(
        self, database: Database, listener: Listener, outbound: Outbound, settings: Settings
    ) -> None:
        super().__init__(listener, settings.poll_s)
        self._database, self._outbound, self._settings = database, outbound, settings

    async def _claim(self, room: int) -> list[dict[str, Any]]:
        lease_s = self._settings.webhook_timeout_s + LEASE_SPARE_S
        return await self._database.fetch(_CLAIM, PER_WEBHOOK, PER_FAILING, lease_s, PER_TENANT, room)

    async def _work(self, row: dict[str, Any]) -> None:
        began, at = time.monotonic(), datetime.now(UTC)
        body = row["body"].encode()
        valid = [secret for secret in (row["secret"], row["previous"]) if secret]
        headers = {
            "Content-Type": "application/json",
            "User-Agent": f"BiResNeRF/{__version__}",
            **signed_headers(row["id"], int(at.timestamp()), body, valid),
        }
        result = await self._post(row["url"], body, headers)
        seconds = time.monotonic() - began
        try:
            async with self._database.transaction() as connection:
                await self._conclude(connection, row, result, at, seconds)
        except (Unavailable, psycopg.Error) as error:
            log.warning("webhook message %s is going to be sent again: %s", row["id"], error)

    async def _post(self, url: str, body: bytes, headers: dict[str, str]) -> Result:
        limit = self._settings.webhook_timeout_s
        try:
            answer = await self._outbound.send("POST", url, body, headers, size=len(body), timeout_s=limit)
        except TROUBLES as error:
            code, again = trouble_of(error)
            return Result("again" if again else "failed", error=code)
        except Exception:
            # Our own failure on one message must not repeat every minute forever.
            log.exception("webhook message %s could not be sent", headers["webhook-id"])
            return Result("again", error="internal")
        return Result(outcome_of(answer.status), answer.status, None, retry_after(answer))

    async def _conclude(
        self, connection: Connection, row: dict[str, Any], result: Result, at: datetime, seconds: float
    ) -> None:
        """Record the outcome. The state of the message changes only while the lease is ours."""
        # Locks the webhook before its messages, as deleting it does.
        lock = "SELECT 1 FROM webhooks WHERE id = %s FOR NO KEY UPDATE"
        if await connection.row(lock, row["webhook_id"]) is None:
            return
        written = await connection.row(
            "UPDATE webhook_deliveries SET attempts = attempts + 1 WHERE id = %s RETURNING attempts",
            row["id"],
        )
        if written is None:  # deleted meanwhile
            return
        await connection.execute(
            "INSERT INTO webhook_attempts (delivery_id, number, at, seconds, status, error)"
            " VALUES (%s, %s, %s, %s, %s, %s)",
            (row["id"], written["attempts"], at, seconds, result.status, result.error),
        )
        round_ = row["round"] + 1
        if result.outcome == "again" and round_ < ROUNDS_MAX:
            pause_s = max(pause(round_, self._settings.webhook_retry_s), result.retry_after_s)
            change, values = "round = %s, due_at = now() + make_interval(secs => %s)", [round_, pause_s]
        else:
            end = "delivered" if result.outcome == "delivered" else "failed"
            change, values = "round = %s, state = %s, finished_at = clock_timestamp()", [round_, end]
        await connection.execute(
            f"UPDATE webhook_deliveries SET leased_until = NULL, {change}"
            " WHERE id = %s AND leased_until = %s AND state = 'pending'".encode(),
            (*values, row["id"], row["leased_until"]),
        )
        await self._note_health(connection, row["webhook_id"], result)

    async def _note_health(self, connection: Connection, webhook_id: str, result: Result) -> None:
        """Record since when a receiver only fails; disable it after days of failures, or when it is gone."""
        if result.outcome == "delivered":
            await connection.execute(
                "UPDATE webhooks SET failing_since = NULL WHERE id = %s AND failing_since IS NOT NULL",
                (webhook_id,),
            )
            return
        gone = result.outcome == "gone"
        row = await connection.row(
            "UPDATE webhooks SET failing_since = coalesce(failing_since, clock_timestamp()),"
            " enabled = enabled AND NOT (%s OR coalesce(failing_since < clock_timestamp()"
            " - make_interval(secs => %s), false)) WHERE id = %s AND enabled RETURNING enabled",
            gone,
            self._settings.webhook_give_up_days * 86_400,
            webhook_id,
        )
        if row is None or row["enabled"]:
            return
        why = "410 Gone" if gone else f"no success in {self._settings.webhook_give_up_days:g} days"
        log.warning("webhook %s is switched off: %s", webhook_id, why)
        await connection.execute("UPDATE webhooks SET disabled_why = %s WHERE id = %s", (why, webhook_id))
        await drop_pending(connection, webhook_id)


def outcome_of(status: int) -> Outcome:
    """The outcome for a status. Redirects are not followed, so they are as final as a refusal."""
    if 200 <= status < 300:
        return "delivered"
    if status == 410:
        return "gone"
    return "again" if status in AGAIN or status >= 500 else "failed"


def pause(round_: int, first_s: float) -> float:
    """Pause (s) after ``round_`` failures: growing fourfold up to 12 h, with some jitter.

    So messages that failed together are not retried together.
    """
    return min(first_s * PAUSE_FACTOR ** (round_ - 1), PAUSE_MAX_S) * random.uniform(1 - JITTER, 1 + JITTER)


def retry_after(answer: Answer) -> float:
    """The receiver's Retry-After in seconds, at most 12 h; 0 if it is missing or malformed."""
    return min(retry_after_s(answer.headers.get("retry-after")) or 0.0, PAUSE_MAX_S)


def signed_headers(delivery_id: str, at: int, body: bytes, valid: Sequence[str]) -> dict[str, str]:
    """The three headers of Standard Webhooks, with one signature for each valid secret.

    Args:
        at: seconds since 1970; a receiver refuses what is older than five minutes.
    """
    content = f"{delivery_id}.{at}.".encode() + body
    signatures = [
        "v1," + base64.b64encode(hmac.new(key_of(secret), content, hashlib.sha256).digest()).decode()
        for secret in valid
    ]
    return {
        "webhook-id": delivery_id,
        "webhook-timestamp": str(at),
        "webhook-signature": " ".join(signatures),
    }
