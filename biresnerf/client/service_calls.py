"""Requests about the service itself."""

from __future__ import annotations

from biresnerf.client.errors import ServiceError
from biresnerf.client.transport import Call, Transport, parse
from biresnerf.wire.service import Info, OptionsView


class ServiceCalls(Transport):
    """Requests about the service itself."""

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
