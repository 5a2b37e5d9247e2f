"""What a webhook and its deliveries look like, and the secrets they are signed with (Standard Webhooks)."""

from __future__ import annotations

import base64
import binascii
import hashlib
import hmac
import secrets
from collections.abc import Sequence
from datetime import datetime
from typing import Annotated, Literal, get_args

from pydantic import AfterValidator, Field

from workers.records import Record

WebhookEvent = Literal[
    "job.queued",
    "job.started",
    "job.succeeded",
    "job.failed",
    "job.cancelled",
    "dataset.validated",
]
ALL_EVENTS: tuple[WebhookEvent, ...] = get_args(WebhookEvent)
TEST_EVENT = "webhook.test"
DeliveryState = Literal["pending", "delivered", "failed"]
SECRET_PREFIX = "whsec_"
SECRET_BYTES = (24, 64)


def _is_secret(text: str) -> str:
    key_of(text)
    return text


Secret = Annotated[str, AfterValidator(_is_secret)]


class Webhook(Record):
    """Who hears of what. The secret is told once, when it is made."""

    id: str
    tenant: str
    url: str
    description: str = ""
    events: tuple[WebhookEvent, ...]
    job_id: str | None = Field(None, description="Hears of this job only, and goes with it.")
    enabled: bool
    disabled_why: str | None = Field(None, description="Why the service switched it off, where it did.")
    failing_since: datetime | None = Field(None, description="No delivery has succeeded since.")
    previous_secret_until: datetime | None = Field(
        None, description="Until then messages are signed with the secret before the last one too."
    )
    created_at: datetime


class WebhookAttempt(Record):
    """One try to deliver: when, how long it took, and the status that came back, or why none did."""

    number: int
    at: datetime
    seconds: float
    status: int | None = None
    error: str | None = None


class WebhookDelivery(Record):
    """One message to one webhook; ``id`` is what the receiver finds in the header `webhook-id`."""

    id: str
    webhook_id: str
    event: str
    state: DeliveryState
    next_attempt_at: datetime | None = Field(None, description="None unless pending.")
    created_at: datetime
    finished_at: datetime | None = None
    body: str = Field(description="The message, byte for byte.")
    attempts: tuple[WebhookAttempt, ...] = ()


class JobWebhook(Record):
    """A webhook for one job, sent along with it. The sender makes the secret."""

    url: str = Field(max_length=2000)
    secret: Secret = Field(
        max_length=200,
        description="`whsec_` and 24 to 64 random bytes in base64; signs the messages.",
        examples=["whsec_MfKQ9r8GKYqrTwjUPD8ILPZIo2LaLaSw"],
    )
    events: tuple[WebhookEvent, ...] = Field(
        ("job.succeeded", "job.failed", "job.cancelled"), min_length=1, max_length=len(ALL_EVENTS)
    )


def request_with(subject: str, webhook: JobWebhook | None) -> str:
    """What a request for a job is about, for its comparison with another one of the same Idempotency-Key."""
    return subject if webhook is None else f"{subject} {webhook.model_dump_json()}"


def new_secret() -> str:
    """A fresh signing secret."""
    return SECRET_PREFIX + base64.b64encode(secrets.token_bytes(32)).decode()


def key_of(secret: str) -> bytes:
    """The bytes that sign; raises `ValueError` where the text is no secret."""
    try:
        key = base64.b64decode(secret.removeprefix(SECRET_PREFIX), validate=True)
    except (binascii.Error, ValueError):
        key = b""
    if not secret.startswith(SECRET_PREFIX) or not SECRET_BYTES[0] <= len(key) <= SECRET_BYTES[1]:
        raise ValueError("a secret is whsec_ and 24 to 64 bytes in base64")
    return key


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
