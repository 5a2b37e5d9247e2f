"""The receiver that docs/webhooks.md shows: a program of its own, which sends a mail for an event it is sent."""

from __future__ import annotations

import email
import socketserver
import subprocess
import sys
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import httpx
import pytest

from tests.docs.documented import ROOT, commands_of
from tests.service.free_port import free_port

pytestmark = pytest.mark.server

EVENT = {"type": "job.succeeded", "data": {"id": "job_0001", "verdict": "improved"}}


class _MailServer(socketserver.StreamRequestHandler):
    """As much of SMTP (RFC 5321) as a client needs that sends one mail; `server.mails` has their texts."""

    def handle(self) -> None:
        self.wfile.write(b"220 ready\r\n")
        for line in self.rfile:
            if line.upper().startswith(b"DATA"):
                self.wfile.write(b"354 go on\r\n")
                self.server.mails.append(b"".join(iter(self.rfile.readline, b".\r\n")))  # type: ignore[attr-defined]
            if line.upper().startswith(b"QUIT"):
                self.wfile.write(b"221 bye\r\n")
                return
            self.wfile.write(b"250 fine\r\n")


@contextmanager
def mail_server() -> Iterator[socketserver.TCPServer]:
    with socketserver.ThreadingTCPServer(("127.0.0.1", 0), _MailServer) as server:
        server.daemon_threads, server.mails = True, []  # type: ignore[attr-defined]
        threading.Thread(target=server.serve_forever, daemon=True).start()
        yield server
        server.shutdown()


@contextmanager
def receiver(folder: Path, mail_port: int) -> Iterator[str]:
    """The documented program, with ports that are free here; its address."""
    (text,) = (c.text for c in commands_of(ROOT / "docs" / "webhooks.md") if "smtplib" in c.text)
    port = free_port()
    for written, here in (("8200", str(port)), ('SMTP("localhost")', f'SMTP("127.0.0.1", {mail_port})')):
        assert text.count(written) == 1
        text = text.replace(written, here)
    (folder / "receiver.py").write_text(text)
    process = subprocess.Popen([sys.executable, str(folder / "receiver.py")])
    try:
        yield f"http://127.0.0.1:{port}/"
    finally:
        process.terminate()
        process.wait()


def post(address: str, event: object) -> httpx.Response:
    """As soon as the receiver listens."""
    for _ in range(600):
        try:
            return httpx.post(address, json=event)
        except httpx.ConnectError:
            time.sleep(0.1)
    raise TimeoutError(f"nothing listens at {address}")


def test_the_documented_receiver_mails_what_became_of_a_job(tmp_path):
    with mail_server() as server, receiver(tmp_path, server.server_address[1]) as address:
        assert post(address, EVENT).status_code == 204
        assert post(address, {"type": "dataset.validated", "data": {"id": "ds_1"}}).status_code == 204
    (mail,) = (email.message_from_bytes(text) for text in server.mails)  # type: ignore[attr-defined]
    assert mail["Subject"] == "job.succeeded: job_0001"
    assert mail["To"] == "you@example.org"
