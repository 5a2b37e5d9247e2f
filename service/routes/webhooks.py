"""Webhooks, their secrets, and the delivery of each message."""

from __future__ import annotations

from typing import Annotated

from fastapi import APIRouter, Query, Response

from biresnerf.wire.webhooks import (
    DeliveryList,
    DeliveryView,
    NewWebhook,
    WebhookChange,
    WebhookList,
    WebhookView,
    WebhookWithSecret,
    delivery_path,
    webhook_url,
)
from service.http.access import JobWriter, ReadCaller
from service.http.dependencies import DeliveryId, Paged, WebhookId
from service.http.problems import declared
from service.intake.json_body import JsonRoute

router = APIRouter(prefix="/v1/webhooks", tags=["webhooks"], route_class=JsonRoute)


@router.post("", status_code=201, responses=declared("webhook_url_refused", "too_many_webhooks"))
async def create_webhook(caller: JobWriter, body: NewWebhook, response: Response) -> WebhookWithSecret:
    """Creates a webhook for all jobs and datasets. The secret is shown only in this response."""
    webhook, secret = await caller.webhooks.create(caller.tenant, body.url, body.events, body.description)
    response.headers["Location"] = webhook_url(webhook.id)
    return WebhookWithSecret(**dict(webhook), secret=secret)


@router.get("")
async def list_webhooks(
    caller: ReadCaller,
    paging: Paged,
    job: Annotated[
        str | None, Query(max_length=100, pattern="^[0-9A-Za-z_]*$", description="Only those of this job.")
    ] = None,
) -> WebhookList:
    """Lists the webhooks for all jobs, or those of one job; newest first."""
    page = await caller.webhooks.list(job_id=job, limit=paging.limit, cursor=paging.cursor)
    return paging.respond(WebhookList, page)


@router.get("/{webhook_id}")
async def get_webhook(webhook_id: WebhookId, caller: ReadCaller) -> WebhookView:
    """The webhook, and since when its deliveries fail."""
    return await caller.webhooks.get(webhook_id)


@router.patch("/{webhook_id}", responses=declared("webhook_url_refused"))
async def change_webhook(caller: JobWriter, webhook_id: WebhookId, body: WebhookChange) -> WebhookView:
    """Changes the given fields; disables or enables the webhook."""
    return await caller.webhooks.change(webhook_id, **body.model_dump())


@router.delete("/{webhook_id}", status_code=204)
async def delete_webhook(webhook_id: WebhookId, caller: JobWriter) -> None:
    """Deletes the webhook with its deliveries; messages that wait are not sent."""
    await caller.webhooks.delete(webhook_id)


@router.post("/{webhook_id}/secret")
async def rotate_webhook_secret(webhook_id: WebhookId, caller: JobWriter) -> WebhookWithSecret:
    """Creates a new secret. For 24 hours messages are also signed with the previous one."""
    webhook, secret = await caller.webhooks.rotate(webhook_id)
    return WebhookWithSecret(**dict(webhook), secret=secret)


@router.post("/{webhook_id}/test", status_code=202, responses=declared("state_conflict"))
async def test_webhook(webhook_id: WebhookId, caller: JobWriter, response: Response) -> DeliveryView:
    """Sends a message `webhook.test`; its delivery is at `Location`."""
    delivery = await caller.webhooks.test(webhook_id)
    response.headers["Location"] = delivery_path(delivery.webhook_id, delivery.id)
    return delivery


@router.get("/{webhook_id}/deliveries")
async def list_deliveries(webhook_id: WebhookId, caller: ReadCaller, paging: Paged) -> DeliveryList:
    """Messages sent and waiting, newest first, with the time and status of every attempt."""
    page = await caller.webhooks.deliveries(webhook_id, limit=paging.limit, cursor=paging.cursor)
    return paging.respond(DeliveryList, page)


@router.get("/{webhook_id}/deliveries/{delivery_id}")
async def get_delivery(webhook_id: WebhookId, delivery_id: DeliveryId, caller: ReadCaller) -> DeliveryView:
    """One message and its attempts."""
    return await caller.webhooks.delivery(webhook_id, delivery_id)


@router.post(
    "/{webhook_id}/deliveries/{delivery_id}/redeliver",
    status_code=202,
    responses=declared("state_conflict"),
)
async def redeliver(webhook_id: WebhookId, delivery_id: DeliveryId, caller: JobWriter) -> DeliveryView:
    """Sends a message again at once, with its original id, so that receivers recognise it."""
    return await caller.webhooks.redeliver(webhook_id, delivery_id)
