"""`AsyncClient`: everything a client can do, on asyncio or trio."""

from __future__ import annotations

from biresnerf.client.downloads import Downloads
from biresnerf.client.events import Events
from biresnerf.client.service_calls import ServiceCalls
from biresnerf.client.submission import Submissions
from biresnerf.client.webhook_calls import WebhookCalls


class AsyncClient(Submissions, Events, Downloads, ServiceCalls, WebhookCalls):
    """Talks to one service, without blocking the event loop. Use as an asynchronous context manager.

    Every method raises `ServiceError`. What fails for a moment is retried for ``patience_s``, with growing pauses or
    when the service asks for it; a request that creates something creates it once. Callbacks may be coroutine
    functions.
    """
