"""`AsyncClient`: everything a client can do, on asyncio or trio."""

from __future__ import annotations

from collections.abc import Sequence
from datetime import date

from biresnerf.client.downloads import Downloads
from biresnerf.client.errors import ServiceError
from biresnerf.client.events import Events
from biresnerf.client.submission import Submissions
from biresnerf.client.transport import Call, parse
from biresnerf.client.webhook_calls import WebhookCalls
from biresnerf.wire.operator import OperatorView
from biresnerf.wire.service import Info, OptionsView, UsageKey, UsageList, UsageRow


class AsyncClient(Submissions, Events, Downloads, WebhookCalls):
    """Talks to one service, without blocking the event loop. Use as an asynchronous context manager.

    Every method raises `ServiceError`. What fails for a moment is retried for ``patience_s``, with growing pauses or
    when the service asks for it; a request that creates something creates it once. Callbacks may be coroutine
    functions.
    """

    async def ready(self) -> bool:
        """Whether the service accepts jobs now. Does not retry."""
        try:
            await self._send(Call("GET", "/readyz"))
        except ServiceError:
            return False
        return True

    async def info(self) -> Info:
        """The service's version and limits, and the caller's share of it."""
        return parse(await self._ask(Call("GET", "/v1/info")), Info)

    async def options(self) -> OptionsView:
        """The JSON Schema of the options, and every preset with its values."""
        return parse(await self._ask(Call("GET", "/v1/options")), OptionsView)

    async def usage(
        self, *, first: date | None = None, last: date | None = None, by: Sequence[UsageKey] = ("day",)
    ) -> tuple[UsageRow, ...]:
        """Processor and GPU seconds used from the day ``first`` to ``last`` (UTC), split ``by``.

        Of the caller's tenant, or of all with the scope `admin`. By default the last 30 days.
        """
        days = {name: day.isoformat() for name, day in (("from", first), ("to", last)) if day}
        answer = await self._ask(Call("GET", "/v1/usage", {"by": ",".join(by), **days}))
        return parse(answer, UsageList).items

    async def operator(self) -> OperatorView:
        """The installation at work: queue, slots, sizes, the latest failures. Needs the scope `admin`."""
        return parse(await self._ask(Call("GET", "/v1/operator")), OperatorView)
