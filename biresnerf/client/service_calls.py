"""What can be asked of a service itself, and its webhooks."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

from biresnerf.client.calls import Call, Flow, Session, ask
from biresnerf.client.errors import ServiceError
from biresnerf.client.pages import collect
from biresnerf.wire.service import Info, OptionsView
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


def ready(session: Session) -> Flow[bool]:
    """Whether the service takes jobs now."""
    try:
        yield Call("GET", "/readyz")
    except ServiceError:
        return False
    return True


def info(session: Session) -> Flow[Info]:
    """Version and limits of the service, and your share of it."""
    answer = yield from ask(session, Call("GET", "/v1/info"))
    return answer.model(Info)


def options(session: Session) -> Flow[OptionsView]:
    """JSON Schema of the options, and every preset with its values."""
    answer = yield from ask(session, Call("GET", "/v1/options"))
    return answer.model(OptionsView)


def create_webhook(
    session: Session, url: str, events: Sequence[WebhookEvent] = ALL_EVENTS, *, description: str = ""
) -> Flow[WebhookWithSecret]:
    """A webhook for all jobs and datasets; the secret in the answer is not told again."""
    body = NewWebhook(url=url, events=list(events), description=description)
    call = Call("POST", "/v1/webhooks", json=body.model_dump(mode="json"), again="undone")
    answer = yield from ask(session, call)
    return answer.model(WebhookWithSecret)


def webhooks(
    session: Session, *, job_id: str | None = None, limit: int | None = None
) -> Flow[list[WebhookView]]:
    """Webhooks for all jobs, or those of one job; the newest first."""
    params = {} if job_id is None else {"job": job_id}
    return (
        yield from collect(
            session, Call("GET", "/v1/webhooks", params), lambda answer: answer.model(WebhookList), limit
        )
    )


def webhook(session: Session, webhook_id: str) -> Flow[WebhookView]:
    """The webhook, and whether it works."""
    answer = yield from ask(session, Call("GET", webhook_url(webhook_id)))
    return answer.model(WebhookView)


def change_webhook(session: Session, webhook_id: str, **changes: Any) -> Flow[WebhookView]:
    """Changes what is given of ``url``, ``events``, ``description`` and ``enabled``."""
    body = WebhookChange.model_validate(changes).model_dump(mode="json", exclude_unset=True)
    answer = yield from ask(session, Call("PATCH", webhook_url(webhook_id), json=body))
    return answer.model(WebhookView)


def delete_webhook(session: Session, webhook_id: str) -> Flow[None]:
    """Deletes it with its deliveries."""
    yield from ask(session, Call("DELETE", webhook_url(webhook_id)))


def rotate_webhook_secret(session: Session, webhook_id: str) -> Flow[WebhookWithSecret]:
    """A new secret; for 24 hours messages are signed with the one before too."""
    call = Call("POST", f"{webhook_url(webhook_id)}/secret", again="undone")
    answer = yield from ask(session, call)
    return answer.model(WebhookWithSecret)


def test_webhook(session: Session, webhook_id: str) -> Flow[DeliveryView]:
    """Sends a message `webhook.test`."""
    call = Call("POST", f"{webhook_url(webhook_id)}/test", again="undone")
    answer = yield from ask(session, call)
    return answer.model(DeliveryView)


def deliveries(session: Session, webhook_id: str, *, limit: int | None = None) -> Flow[list[DeliveryView]]:
    """What was sent and what waits, the newest first."""
    call = Call("GET", f"{webhook_url(webhook_id)}/deliveries")
    return (yield from collect(session, call, lambda answer: answer.model(DeliveryList), limit))


def delivery(session: Session, webhook_id: str, delivery_id: str) -> Flow[DeliveryView]:
    """One message and its attempts."""
    answer = yield from ask(session, Call("GET", delivery_path(webhook_id, delivery_id)))
    return answer.model(DeliveryView)


def redeliver(session: Session, webhook_id: str, delivery_id: str) -> Flow[DeliveryView]:
    """Sends a message again at once, under the id it had."""
    call = Call("POST", f"{delivery_path(webhook_id, delivery_id)}/redeliver", again="undone")
    answer = yield from ask(session, call)
    return answer.model(DeliveryView)
