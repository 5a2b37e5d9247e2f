"""Requests about webhooks and their deliveries."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

from biresnerf.client.transport import Call, Transport, parse
from biresnerf.wire.webhooks import (
    ALL_EVENTS,
    DeliveryList,
    DeliveryView,
    NewWebhook,
    WebhookChange,
    WebhookEvent,
    WebhookList,
    WebhookView,
    WebhookWithSecret,
    delivery_path,
    webhook_url,
)


class WebhookCalls(Transport):
    """Requests about webhooks and their deliveries."""

    async def create_webhook(
        self, url: str, events: Sequence[WebhookEvent] = ALL_EVENTS, *, description: str = ""
    ) -> WebhookWithSecret:
        """Creates a webhook for all jobs and datasets. Only this answer holds its secret."""
        body = NewWebhook(url=url, events=list(events), description=description).model_dump(mode="json")
        return parse(
            await self._ask(Call("POST", "/v1/webhooks", json=body, again="undone")), WebhookWithSecret
        )

    async def webhooks(self, *, job_id: str | None = None, limit: int | None = None) -> list[WebhookView]:
        """Webhooks for all jobs, or those of one job; newest first."""
        params = {} if job_id is None else {"job": job_id}
        return await self._collect(Call("GET", "/v1/webhooks", params), WebhookList, limit)

    async def webhook(self, webhook_id: str) -> WebhookView:
        """The webhook, with the state of its deliveries."""
        return parse(await self._ask(Call("GET", webhook_url(webhook_id))), WebhookView)

    async def change_webhook(self, webhook_id: str, **changes: Any) -> WebhookView:
        """Changes any of ``url``, ``events``, ``description`` and ``enabled``."""
        body = WebhookChange.model_validate(changes).model_dump(mode="json", exclude_unset=True)
        return parse(await self._ask(Call("PATCH", webhook_url(webhook_id), json=body)), WebhookView)

    async def delete_webhook(self, webhook_id: str) -> None:
        """Deletes the webhook and its deliveries."""
        await self._ask(Call("DELETE", webhook_url(webhook_id)))

    async def rotate_webhook_secret(self, webhook_id: str) -> WebhookWithSecret:
        """Creates a new secret; messages are also signed with the old one for 24 hours."""
        call = Call("POST", f"{webhook_url(webhook_id)}/secret", again="undone")
        return parse(await self._ask(call), WebhookWithSecret)

    async def test_webhook(self, webhook_id: str) -> DeliveryView:
        """Sends a `webhook.test` message."""
        call = Call("POST", f"{webhook_url(webhook_id)}/test", again="undone")
        return parse(await self._ask(call), DeliveryView)

    async def deliveries(self, webhook_id: str, *, limit: int | None = None) -> list[DeliveryView]:
        """Messages that were sent or wait to be sent, newest first."""
        return await self._collect(Call("GET", f"{webhook_url(webhook_id)}/deliveries"), DeliveryList, limit)

    async def delivery(self, webhook_id: str, delivery_id: str) -> DeliveryView:
        """One message and its attempts."""
        return parse(await self._ask(Call("GET", delivery_path(webhook_id, delivery_id))), DeliveryView)

    async def redeliver(self, webhook_id: str, delivery_id: str) -> DeliveryView:
        """Sends a message again, now and under the same id."""
        call = Call("POST", f"{delivery_path(webhook_id, delivery_id)}/redeliver", again="undone")
        return parse(await self._ask(call), DeliveryView)
