"""What answers about webhooks look like, for the OpenAPI document: by the name of their schema."""

from __future__ import annotations

import json
from typing import Any

from biresnerf.wire.webhooks import ALL_EVENTS

_AT = "2026-11-21T19:00:00Z"
_WEBHOOK_ID, _DELIVERY_ID = "wh_01JD8Y3V1QKZ5M0C7W2N4T6XAB", "msg_5f1c0d9e6a0b4a3c8d7e6f5a4b3c2d1e"
_HERE = f"/v1/webhooks/{_WEBHOOK_ID}"
_DELIVERY = f"{_HERE}/deliveries/{_DELIVERY_ID}"

_WEBHOOK_VIEW: dict[str, Any] = {
    "id": _WEBHOOK_ID,
    "tenant": "local",
    "url": "https://hooks.example.org/biresnerf",
    "description": "",
    "events": list(ALL_EVENTS),
    "job_id": None,
    "enabled": True,
    "disabled_why": None,
    "failing_since": None,
    "previous_secret_until": None,
    "created_at": _AT,
    "links": {
        "self": _HERE,
        "deliveries": f"{_HERE}/deliveries",
        "test": f"{_HERE}/test",
        "rotate": f"{_HERE}/secret",
    },
}
_DELIVERY_VIEW: dict[str, Any] = {
    "id": _DELIVERY_ID,
    "webhook_id": _WEBHOOK_ID,
    "event": "webhook.test",
    "state": "delivered",
    "next_attempt_at": None,
    "created_at": _AT,
    "finished_at": "2026-11-21T19:00:06Z",
    "body": json.dumps({"type": "webhook.test", "timestamp": _AT, "data": {"webhook_id": _WEBHOOK_ID}}),
    "attempts": [
        {"number": 1, "at": _AT, "seconds": 0.412, "status": 503, "error": None},
        {"number": 2, "at": "2026-11-21T19:00:05.6Z", "seconds": 0.081, "status": 204, "error": None},
    ],
    "links": {"self": _DELIVERY, "redeliver": f"{_DELIVERY}/redeliver"},
}

WEBHOOK_EXAMPLES: dict[str, Any] = {
    "WebhookView": _WEBHOOK_VIEW,
    "WebhookWithSecret": {**_WEBHOOK_VIEW, "secret": "whsec_MfKQ9r8GKYqrTwjUPD8ILPZIo2LaLaSwMfKQ9r8GKYo="},
    "WebhookList": {"items": [_WEBHOOK_VIEW], "next_cursor": None},
    "DeliveryView": _DELIVERY_VIEW,
    "DeliveryList": {"items": [_DELIVERY_VIEW], "next_cursor": None},
}
