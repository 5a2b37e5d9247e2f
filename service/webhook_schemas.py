"""Webhooks on the wire."""

from __future__ import annotations

from typing import Annotated
from urllib.parse import quote

from pydantic import ConfigDict, Field, StringConstraints

from service.schemas import Wire
from workers.webhook_records import ALL_EVENTS, Webhook, WebhookDelivery, WebhookEvent

Events = Annotated[list[WebhookEvent], Field(min_length=1, max_length=len(ALL_EVENTS))]
Description = Annotated[str, StringConstraints(max_length=200, pattern=r"^[^\x00-\x1f]*$")]
Url = Annotated[str, Field(max_length=2000, examples=["https://hooks.example.org/biresnerf"])]


class NewWebhook(Wire):
    """A webhook to make."""

    model_config = ConfigDict(
        json_schema_extra={
            "examples": [
                {"url": "https://hooks.example.org/poses", "events": ["job.succeeded", "job.failed"]}
            ]
        }
    )

    url: Url
    events: Events = Field(default=list(ALL_EVENTS), description="What to send; everything where left out.")
    description: Description = ""


class WebhookChange(Wire):
    """What to change of a webhook; what is left out stays."""

    model_config = ConfigDict(json_schema_extra={"examples": [{"enabled": True}]})

    url: Url | None = None
    events: Events | None = None
    description: Description | None = None
    enabled: bool | None = Field(None, description="Off drops what waits; on (again) forgets failures.")


class WebhookLinks(Wire):
    """Where the parts of a webhook are."""

    self: str
    deliveries: str
    test: str
    rotate: str


class WebhookView(Webhook):
    """A webhook with links."""

    links: WebhookLinks

    @classmethod
    def of(cls, webhook: Webhook) -> WebhookView:
        """The webhook as the wire has it."""
        return cls(**dict(webhook), links=_links(webhook.id))


class WebhookWithSecret(WebhookView):
    """A webhook with the secret its messages are signed with, which is not told again."""

    secret: str = Field(examples=["whsec_MfKQ9r8GKYqrTwjUPD8ILPZIo2LaLaSwMfKQ9r8GKYo="])

    @classmethod
    def made(cls, webhook: Webhook, secret: str) -> WebhookWithSecret:
        """The answer to who made the webhook or a new secret of it."""
        return cls(**dict(webhook), links=_links(webhook.id), secret=secret)


class WebhookList(Wire):
    """A page of webhooks, newest first."""

    items: list[WebhookView]
    next_cursor: str | None = Field(None, description="Opaque; null on the last page.")


class DeliveryLinks(Wire):
    """Where the parts of a delivery are."""

    self: str
    redeliver: str


class DeliveryView(WebhookDelivery):
    """A delivery with links."""

    links: DeliveryLinks

    @classmethod
    def of(cls, delivery: WebhookDelivery) -> DeliveryView:
        """The delivery as the wire has it."""
        here = delivery_url(delivery)
        return cls(**dict(delivery), links=DeliveryLinks(self=here, redeliver=f"{here}/redeliver"))


class DeliveryList(Wire):
    """A page of deliveries, newest first."""

    items: list[DeliveryView]
    next_cursor: str | None = None


def webhook_url(webhook_id: str) -> str:
    """The webhook's path."""
    return f"/v1/webhooks/{quote(webhook_id, safe='')}"


def delivery_url(delivery: WebhookDelivery) -> str:
    """The delivery's path."""
    return f"{webhook_url(delivery.webhook_id)}/deliveries/{quote(delivery.id, safe='')}"


def _links(webhook_id: str) -> WebhookLinks:
    here = webhook_url(webhook_id)
    return WebhookLinks(
        self=here, deliveries=f"{here}/deliveries", test=f"{here}/test", rotate=f"{here}/secret"
    )
