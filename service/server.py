"""The web process: `python -m service.server`, settings from the environment."""

from __future__ import annotations

import asyncio
import logging
import socket
import sys
from types import FrameType

import uvicorn
from fastapi import FastAPI
from pydantic import ValidationError

from service.app import create_app
from service.http.request_context import HEAD_BYTES_MAX
from service.http.strict_http import StrictHttp
from workers.settings.errors import SetupError
from workers.settings.logs import set_up_logging
from workers.settings.settings import Settings
from workers.settings.traces import set_up_traces

logger = logging.getLogger(__name__)
# Long downloads may use it; event streams end at once (see `_Server`).
_SHUTDOWN_GRACE_S = 5
# Longer than proxies keep idle connections, which would otherwise send into one that we are closing.
KEEP_ALIVE_S = 75


class _Server(uvicorn.Server):
    """Ends event streams when asked to stop; uvicorn alone would wait for them."""

    def __init__(self, config: uvicorn.Config, app: FastAPI) -> None:
        super().__init__(config)
        self._app = app

    def handle_exit(self, sig: int, frame: FrameType | None) -> None:
        service = getattr(self._app.state, "service", None)
        if service is not None:
            asyncio.get_running_loop().call_soon_threadsafe(service.closing.set)
        super().handle_exit(sig, frame)


def listen(settings: Settings) -> socket.socket:
    """The bound socket; raises `SetupError` where the address cannot be had."""
    family = socket.AF_INET6 if ":" in settings.host else socket.AF_INET
    bound = socket.socket(family, socket.SOCK_STREAM)
    bound.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
    try:
        bound.bind((settings.host, settings.port))
    except OSError as error:
        bound.close()
        raise SetupError(
            "address_unavailable",
            f"Cannot listen on {settings.host}:{settings.port} ({error.strerror}). "
            "Set BIRESNERF_PORT to a free port.",
        ) from None
    return bound


def serve(settings: Settings) -> None:
    """Serves until SIGINT or SIGTERM; raises `SetupError`."""
    settings.require_database_url()
    set_up_traces("api", settings)
    bound = listen(settings)
    app = create_app(settings)
    config = uvicorn.Config(
        app,
        log_config=None,
        access_log=False,
        server_header=False,
        timeout_graceful_shutdown=_SHUTDOWN_GRACE_S,
        lifespan="on",
        http=StrictHttp,
        ws="none",
        h11_max_incomplete_event_size=HEAD_BYTES_MAX,
        timeout_keep_alive=KEEP_ALIVE_S,
    )
    server = _Server(config, app)
    host, port = bound.getsockname()[:2]
    logger.info("listening on http://%s:%d", host, port)
    server.run(sockets=[bound])
    if not server.started:
        raise SetupError("start_failed", "The service could not start; see the lines above.")


def main() -> int:
    """Returns the exit status: 0 stopped, 2 the operator has to change something."""
    try:
        settings = Settings()
        set_up_logging("api", settings)
        serve(settings)
    except (SetupError, ValidationError) as error:
        sys.stderr.write(f"{error}\n")
        return 2
    return 0


if __name__ == "__main__":
    sys.exit(main())
