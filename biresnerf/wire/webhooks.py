"""Webhooks, their secrets and deliveries (Standard Webhooks)."""

from __future__ import annotations

import base64
import binascii
import secrets
from datetime import datetime
from typing import Annotated, Literal, get_args
from urllib.parse import quote

from pydantic import AfterValidator, ConfigDict, Field, StringConstraints

from biresnerf.wire.base import NO_CONTROLS, Links, Page, Record

WebhookEvent = Literal[
    "job.queued",
    "job.started",
    "job.succeeded",
    "job.failed",
    "job.cancelled",
    "job.expired",
    "batch.finished",
    "dataset.validated",
]
ALL_EVENTS: tuple[WebhookEvent, ...] = get_args(WebhookEvent)
DeliveryState = Literal["pending", "delivered", "failed"]
SECRET_PREFIX = "whsec_"
SECRET_BYTES = (24, 64)
Events = Annotated[list[WebhookEvent], Field(min_length=1, max_length=len(ALL_EVENTS))]
Description = Annotated[str, StringConstraints(max_length=200, pattern=NO_CONTROLS)]
Url = Annotated[str, Field(max_length=2000, examples=["https://hooks.example.org/biresnerf"])]


def new_secret() -> str:
    """A new signing secret."""
    return SECRET_PREFIX + base64.b64encode(secrets.token_bytes(32)).decode()


def key_of(secret: str) -> bytes:
    """The signing key; raises `ValueError` if the text is no secret."""
    try:
        key = base64.b64decode(secret.removeprefix(SECRET_PREFIX), validate=True)
    except (binascii.Error, ValueError):
        key = b""
    if not secret.startswith(SECRET_PREFIX) or not SECRET_BYTES[0] <= len(key) <= SECRET_BYTES[1]:
        raise ValueError("a secret is whsec_ and 24 to 64 bytes in base64")
    return key


def _is_secret(text: str) -> str:
    key_of(text)
    return text


Secret = Annotated[str, AfterValidator(_is_secret)]


class WebhookLinks(Links):
    """Paths of the parts of a webhook."""

    deliveries: str
    test: str
    rotate: str


class WebhookView(Record):
    """A webhook. Its secret is shown only once, when it is created."""

    id: str = Field(examples=["wh_01JD8Y3V1QKZ5M0C7W2N4T6XAB"])
    tenant: str = Field(examples=["local"])
    url: str = Field(examples=["https://hooks.example.org/biresnerf"])
    description: str = ""
    events: tuple[WebhookEvent, ...] = Field(examples=[["job.succeeded", "job.failed"]])
    job_id: str | None = Field(
        None, description="Only events of this job are sent; the webhook is deleted with the job."
    )
    batch_id: str | None = Field(
        None, description="Only the end of this batch is sent; the webhook is deleted with the batch."
    )
    enabled: bool = Field(examples=[True])
    disabled_why: str | None = Field(None, description="Why the service disabled it; null if it did not.")
    failing_since: datetime | None = Field(None, description="No delivery has succeeded since then.")
    previous_secret_until: datetime | None = Field(
        None, description="Until then messages are also signed with the previous secret."
    )
    created_at: datetime
    links: WebhookLinks = Field(
        default_factory=lambda fields: WebhookLinks.below(
            webhook_url(fields.get("id", "")), rotate=f"{webhook_url(fields.get('id', ''))}/secret"
        )
    )


class WebhookAttempt(Record):
    """One attempt to deliver: its time, duration, and the status received, or the error."""

    number: int = Field(examples=[1])
    at: datetime
    seconds: float = Field(examples=[0.412])
    status: int | None = Field(None, examples=[204])
    error: str | None = None


class DeliveryLinks(Links):
    """Paths of the parts of a delivery."""

    redeliver: str


class DeliveryView(Record):
    """One message to one webhook; the receiver finds ``id`` in the header `webhook-id`."""

    id: str = Field(examples=["msg_5f1c0d9e6a0b4a3c8d7e6f5a4b3c2d1e"])
    webhook_id: str = Field(examples=["wh_01JD8Y3V1QKZ5M0C7W2N4T6XAB"])
    event: str = Field(examples=["webhook.test"])
    state: DeliveryState = Field(examples=["delivered"])
    next_attempt_at: datetime | None = Field(None, description="Null unless pending.")
    created_at: datetime
    finished_at: datetime | None = None
    body: str = Field(
        examples=['{"type": "webhook.test", "timestamp": "2026-11-21T19:00:00Z", "data": {}}'],
        description="The message, byte for byte.",
    )
    attempts: tuple[WebhookAttempt, ...] = ()
    links: DeliveryLinks = Field(
        default_factory=lambda fields: DeliveryLinks.below(
            delivery_path(fields.get("webhook_id", ""), fields.get("id", ""))
        )
    )


class BatchWebhook(Record):
    """A webhook for the end of one batch, part of its request. The client chooses the secret."""

    url: str = Field(max_length=2000)
    secret: Secret = Field(
        max_length=200,
        description="`whsec_` and 24 to 64 random bytes in base64; signs the messages.",
        examples=["whsec_MfKQ9r8GKYqrTwjUPD8ILPZIo2LaLaSw"],
    )


class JobWebhook(BatchWebhook):
    """A webhook for one job, part of its request. The client chooses the secret."""

    events: tuple[WebhookEvent, ...] = Field(
        ("job.succeeded", "job.failed", "job.cancelled", "job.expired"),
        min_length=1,
        max_length=len(ALL_EVENTS),
    )


class NewWebhook(Record):
    """A webhook to create."""

    model_config = ConfigDict(
        json_schema_extra={
            "examples": [
                {"url": "https://hooks.example.org/poses", "events": ["job.succeeded", "job.failed"]}
            ]
        }
    )

    url: Url
    events: Events = Field(default=list(ALL_EVENTS), description="Events to send; all by default.")
    description: Description = ""


class WebhookChange(Record):
    """Changes of a webhook; fields that are left out stay as they are."""

    model_config = ConfigDict(json_schema_extra={"examples": [{"enabled": True}]})

    url: Url | None = None
    events: Events | None = None
    description: Description | None = None
    enabled: bool | None = Field(
        None, description="`false` drops the messages that wait; `true` forgets earlier failures."
    )


class WebhookWithSecret(WebhookView):
    """A webhook with its signing secret, which is shown only this once."""

    secret: str = Field(examples=["whsec_MfKQ9r8GKYqrTwjUPD8ILPZIo2LaLaSwMfKQ9r8GKYo="])


class WebhookList(Page[WebhookView]):
    """A page of webhooks, newest first."""


class DeliveryList(Page[DeliveryView]):
    """A page of deliveries, newest first."""


def webhook_url(webhook_id: str) -> str:
    """The webhook's path."""
    return f"/v1/webhooks/{quote(webhook_id, safe='')}"


def delivery_path(webhook_id: str, delivery_id: str) -> str:
    """The path of a delivery."""
    return f"{webhook_url(webhook_id)}/deliveries/{quote(delivery_id, safe='')}"
