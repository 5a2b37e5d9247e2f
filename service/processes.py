"""Web processes that share one listening socket, which their parent holds.

While one is replaced, the others accept connections; if there is only one, clients wait in the socket's backlog.
"""

from __future__ import annotations

import socket
import sys
import tempfile
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass

from workers.settings.errors import SetupError
from workers.settings.settings import Settings
from workers.upkeep.supervise import ChildSpec

# The variable by which prometheus_client finds the counters of all processes.
COUNTERS_VARIABLE = "PROMETHEUS_MULTIPROC_DIR"


@dataclass(frozen=True)
class WebProcesses:
    """The port they listen on, and how they are started."""

    port: int
    children: tuple[ChildSpec, ...]


def listen(settings: Settings) -> socket.socket:
    """The bound socket; raises `SetupError` if the address is not available."""
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


@contextmanager
def web_processes(settings: Settings) -> Iterator[WebProcesses]:
    """The processes for the supervisor, with their socket and counters held meanwhile; raises `SetupError`."""
    with ExitStack() as held:
        bound = held.enter_context(listen(settings))
        port = bound.getsockname()[1]
        # The address decides whether a key is needed.
        variables = {"BIRESNERF_HOST": settings.host, "BIRESNERF_PORT": str(port)}
        if settings.processes > 1:
            folder = held.enter_context(
                tempfile.TemporaryDirectory(prefix="biresnerf-counters-", ignore_cleanup_errors=True)
            )
            variables[COUNTERS_VARIABLE] = folder
        names = ["api"] if settings.processes == 1 else [f"api{n}" for n in range(settings.processes)]
        inherited = bound.fileno()
        children = tuple(
            ChildSpec(
                name,
                (sys.executable, "-m", "service.server", "--name", name, "--listen-fd", str(inherited)),
                variables,
                descriptors=(inherited,),
            )
            for name in names
        )
        yield WebProcesses(port, children)
