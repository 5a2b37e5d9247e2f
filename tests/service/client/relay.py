"""A relay between client and service that can be cut."""

from __future__ import annotations

import socket
import struct
import threading
from contextlib import suppress


class Relay:
    """Passes connections on to the service, counts what goes there, and cuts them all when told to."""

    def __init__(self, target_port: int) -> None:
        self._target = target_port
        self._listener = socket.create_server(("127.0.0.1", 0))
        self.port: int = self._listener.getsockname()[1]
        self.sent = 0
        self._open: set[socket.socket] = set()
        threading.Thread(target=self._accept, daemon=True).start()

    def _accept(self) -> None:
        while True:
            try:
                here, _ = self._listener.accept()
            except OSError:  # closed
                return
            try:
                there = socket.create_connection(("127.0.0.1", self._target))
            except OSError:  # the service is down
                here.close()
                continue
            self._open |= {here, there}
            for source, sink, counted in ((here, there, True), (there, here, False)):
                threading.Thread(target=self._pump, args=(source, sink, counted), daemon=True).start()

    def _pump(self, source: socket.socket, sink: socket.socket, counted: bool) -> None:
        try:
            while data := source.recv(256 * 1024):
                sink.sendall(data)
                if counted:
                    self.sent += len(data)
        except OSError:
            pass  # cut, here or there
        for end in (source, sink):
            self._open.discard(end)
            with suppress(OSError):  # not connected any more
                end.shutdown(socket.SHUT_RDWR)  # wakes the other direction, which `close` alone would not
            end.close()

    def cut(self) -> None:
        """Every connection ends as if the cable were pulled: reset, without a goodbye."""
        for end in list(self._open):
            try:
                end.setsockopt(socket.SOL_SOCKET, socket.SO_LINGER, struct.pack("ii", 1, 0))
                end.shutdown(socket.SHUT_RDWR)
            except OSError:
                continue  # it ended by itself

    def close(self) -> None:
        """Nobody gets through any more."""
        self._listener.shutdown(socket.SHUT_RDWR)
        self._listener.close()
        self.cut()
