"""The web process: `python -m service.server`, settings from the environment.

If there are several, the supervisor gives them a shared socket (`service.processes`).
"""

from __future__ import annotations

import argparse
import asyncio
import logging
import socket
import sys
import time
from types import FrameType

import uvicorn
from fastapi import FastAPI
from pydantic import ValidationError

from service.app import create_app
from service.http.request_context import HEAD_BYTES_MAX
from service.http.strict_http import StrictHttp
from service.processes import listen
from workers.settings.errors import SetupError
from workers.settings.logs import set_up_logging
from workers.settings.settings import Settings
from workers.settings.traces import set_up_traces

logger = logging.getLogger(__name__)
# Long downloads may use it; event streams end at once (see `_Server`).
_SHUTDOWN_GRACE_S = 5
# For clients with sequential requests: their next response announces the end of the connection.
FAREWELL_S = 1.0
# Longer than proxies keep idle connections, which would otherwise send into one that we are closing.
KEEP_ALIVE_S = 75


class _Server(uvicorn.Server):
    """Ends event streams on shutdown, which uvicorn would wait for, but no connection in mid-request."""

    def __init__(self, config: uvicorn.Config, app: FastAPI) -> None:
        super().__init__(config)
        self._app = app

    def handle_exit(self, sig: int, frame: FrameType | None) -> None:
        service = getattr(self._app.state, "service", None)
        if service is not None:
            asyncio.get_running_loop().call_soon_threadsafe(service.closing.set)
        super().handle_exit(sig, frame)

    async def shutdown(self, sockets: list[socket.socket] | None = None) -> None:
        """Stops accepting connections, and lets idle ones end with their next response.

        Closed at once, they would lose the requests that are on their way.
        """
        for server in self.servers:
            server.close()
        self.server_state.default_headers = [
            *self.server_state.default_headers,
            (b"connection", b"close"),
        ]
        end = time.monotonic() + FAREWELL_S
        while self.server_state.connections and not self.force_exit and time.monotonic() < end:
            await asyncio.sleep(0.02)
        await super().shutdown(sockets)


def serve(settings: Settings, bound: socket.socket | None = None) -> None:
    """Serves until SIGINT or SIGTERM, on the parent's bound socket or else on a new one.

    Raises `SetupError`.
    """
    settings.require_database_url()
    set_up_traces("api", settings)
    bound = bound or listen(settings)
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
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--name", default="api", help="In the lines of the log.")
    parser.add_argument("--listen-fd", type=int, help="Number of the inherited socket.")
    arguments = parser.parse_args()
    try:
        settings = Settings()
        set_up_logging(arguments.name, settings)
        fd = arguments.listen_fd
        serve(settings, None if fd is None else socket.socket(fileno=fd))
    except (SetupError, ValidationError) as error:
        sys.stderr.write(f"{error}\n")
        return 2
    return 0


if __name__ == "__main__":
    sys.exit(main())
