"""How messages of webhooks are signed (Standard Webhooks), and what a request with a webhook is about."""

from __future__ import annotations

import base64
import hashlib
import hmac
from collections.abc import Sequence

from biresnerf.wire.webhooks import JobWebhook, key_of

TEST_EVENT = "webhook.test"


def request_with(subject: str, webhook: JobWebhook | None) -> str:
    """What a request for a job is about, for its comparison with another one of the same Idempotency-Key."""
    return subject if webhook is None else f"{subject} {webhook.model_dump_json()}"


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
