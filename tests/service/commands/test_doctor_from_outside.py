"""`biresnerf doctor --service`: real services, good and broken."""

from __future__ import annotations

import contextlib
import email.utils
import json
import os
import signal
import socket
import ssl
import subprocess
import sys
import threading
import time
from collections.abc import Iterator
from datetime import timedelta
from http.server import BaseHTTPRequestHandler, SimpleHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path
from typing import Any

import httpx
import psutil
import pytest
import trustme
from click.testing import CliRunner

from biresnerf import __version__
from biresnerf.commands.machine.doctor import doctor_command
from tests.service.conftest import PROGRAM, Running, dataset_ids, ready_dataset, running_service, submit
from tests.service.free_port import free_port
from tests.workers.conftest import short_folder

pytestmark = pytest.mark.server
COMMAND = (sys.executable, str(PROGRAM))


def examined(url: str, key: str | None = None, **variables: str) -> dict[str, dict[str, str]]:
    """The findings by name. The exit status says whether one is broken, and all but the good ones say what to do."""
    environment = {"BIRESNERF_API_KEY": key, **variables}
    result = CliRunner().invoke(doctor_command, ["--json", "--service", url], env=environment)
    assert result.exception is None or isinstance(result.exception, SystemExit), result.output
    said = json.loads(result.stdout)
    assert said["good"] is all(check["state"] != "broken" for check in said["checks"])
    assert all(check["hint"] for check in said["checks"] if check["state"] != "good"), said
    return {check["name"]: check for check in said["checks"]}


def broken(found: dict[str, dict[str, str]]) -> set[str]:
    return {name for name, check in found.items() if check["state"] == "broken"}


@contextlib.contextmanager
def listening(handler: type[BaseHTTPRequestHandler], context: ssl.SSLContext | None = None) -> Iterator[int]:
    with ThreadingHTTPServer(("127.0.0.1", 0), handler) as server:
        if context is not None:
            server.socket = context.wrap_socket(server.socket, server_side=True)
        threading.Thread(target=server.serve_forever, daemon=True).start()
        yield server.server_port
        server.shutdown()


def proxy_of(url: str, clock_off_s: float = 0.0) -> type[BaseHTTPRequestHandler]:
    """Passes everything on, with another clock's time."""

    class Proxy(BaseHTTPRequestHandler):
        protocol_version = "HTTP/1.1"

        def _forward(self) -> None:
            body = self.rfile.read(int(self.headers.get("content-length", 0)))
            headers = {name: value for name, value in self.headers.items() if name.lower() != "host"}
            answer = httpx.request(self.command, url + self.path, headers=headers, content=body, timeout=60)
            self.send_response_only(answer.status_code)
            self.send_header("Date", email.utils.formatdate(time.time() + clock_off_s, usegmt=True))
            for name in ("content-type", "location", "retry-after"):
                if name in answer.headers:
                    self.send_header(name, answer.headers[name])
            self.send_header("Content-Length", str(len(answer.content)))
            self.end_headers()
            self.wfile.write(answer.content)

        def __getattr__(self, name: str) -> Any:
            if name.startswith("do_"):
                return self._forward
            raise AttributeError(name)

        def log_message(self, *_: Any) -> None:
            pass

    return Proxy


def test_a_good_service_is_good_and_nothing_is_left_in_it(service: Running, http: httpx.Client) -> None:
    before = dataset_ids(http)
    found = examined(service.url)
    assert list(found) == [
        *("reachable", "TLS", "ready", "clock", "metrics", "key", "version", "workers", "room", "upload")
    ]
    assert {check["state"] for check in found.values()} == {"good"}, found
    assert found["version"]["detail"] == __version__
    assert found["workers"]["detail"].startswith("1 alive")
    assert dataset_ids(http) == before


def test_people_read_lines_and_scripts_the_exit_status(service: Running) -> None:
    good = CliRunner().invoke(doctor_command, ["--service", service.url])
    assert "good     upload       3 pictures sent, checked and deleted" in good.stdout
    nobody = CliRunner().invoke(doctor_command, ["--service", f"http://127.0.0.1:{free_port()}"])
    assert nobody.stdout.splitlines()[0].startswith("broken   reachable")
    assert "Check address, port and firewall" in nobody.stdout
    statuses = [
        subprocess.run(
            [sys.executable, "-m", "biresnerf.command_line", "doctor", "--service", url]
        ).returncode
        for url in (service.url, f"http://127.0.0.1:{free_port()}")
    ]
    assert statuses == [0, 1]


def test_another_program_and_a_wrong_address_are_told(service: Running) -> None:
    with listening(SimpleHTTPRequestHandler) as port:
        found = examined(f"http://127.0.0.1:{port}")
    assert found["reachable"]["detail"] == "/livez answers 404, not as BiResNeRF does"
    assert "address such as" in examined("poses.example.org")["reachable"]["hint"]


def test_a_clock_that_is_off_is_broken(service: Running) -> None:
    with listening(proxy_of(service.url, -3600)) as port:
        found = examined(f"http://127.0.0.1:{port}")
    assert broken(found) == {"clock"}
    assert "behind" in found["clock"]["detail"]


def test_certificates_are_checked_and_their_end_is_told(
    service: Running, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    authority = trustme.CA()
    authority.cert_pem.write_to_path(tmp_path / "authority.pem")
    monkeypatch.setenv("SSL_CERT_FILE", str(tmp_path / "authority.pem"))

    def context(**days: Any) -> ssl.SSLContext:
        made = ssl.SSLContext(ssl.PROTOCOL_TLS_SERVER)
        authority.issue_cert("localhost", **days).configure_cert(made)
        return made

    now = email.utils.localtime()
    for days, bad in ((90, set()), (5, {"TLS"})):
        expires = now + timedelta(days=days, hours=1)
        with listening(proxy_of(service.url), context(not_after=expires)) as port:
            found = examined(f"https://localhost:{port}")
        assert broken(found) == bad, found
        assert found["TLS"]["detail"] == f"the certificate is valid for {days} days"
    with listening(proxy_of(service.url), context()) as port:
        monkeypatch.delenv("SSL_CERT_FILE")
        found = examined(f"https://localhost:{port}")
    assert list(found) == ["TLS"]
    assert "certificate is refused" in found["TLS"]["detail"]


def test_keys_are_told_with_their_scopes() -> None:
    with short_folder() as folder, running_service(folder, auth="required", job_command=COMMAND) as running:

        def key(scopes: str) -> str:
            command = [sys.executable, "-m", "biresnerf.command_line", "keys", "create", "x", "--json"]
            said = {**os.environ, "BIRESNERF_DATA_DIR": str(running.data_dir)}
            made = subprocess.run(
                [*command, *(word for scope in scopes.split(",") for word in ("--scope", scope))],
                env=said,
                capture_output=True,
                check=True,
            )
            return str(json.loads(made.stdout)["key"])

        for wrong in (None, "brn_" + "x" * 40):
            found = examined(running.url, wrong)
            assert broken(found) == {"key"}
            assert "upload" not in found
        reader = examined(running.url, key("read"))
        assert reader["key"]["detail"] == "tenant local, scopes read"
        assert (reader["upload"]["state"], broken(reader)) == ("missing", set())
        assert examined(running.url, key("read,datasets:write"))["upload"]["state"] == "good"


def test_a_service_that_is_open_to_everybody_is_broken() -> None:
    address = next(
        item.address
        for items in psutil.net_if_addrs().values()
        for item in items
        if item.family == socket.AF_INET and not item.address.startswith("127.")
    )
    with (
        short_folder() as folder,
        running_service(folder, host="0.0.0.0", auth="off", job_command=COMMAND) as running,
    ):
        found = examined(f"http://{address}:{running.url.rpartition(':')[2]}")
    assert broken(found) == {"TLS", "key"}
    assert found["metrics"]["state"] == "good"


def test_workers_database_and_room_that_are_away_are_told(scene: Path) -> None:
    reserve = 2**60  # nothing may be stored
    with short_folder() as folder:
        with running_service(folder, job_command=COMMAND, stall_s=3.0) as running:
            supervisor = psutil.Process(running.process.pid)
            with httpx.Client(base_url=running.url, timeout=60.0) as client:
                (slot,) = [p for p in supervisor.children() if "workers.queue.slot" in p.cmdline()]
                slot.send_signal(signal.SIGSTOP)
                submit(client, ready_dataset(client, scene))
                _until(lambda: client.get("/v1/info").json()["workers"] == 0)
            found = examined(running.url)
            assert broken(found) == {"workers"}
            assert found["workers"]["detail"] == "none is alive; 1 of your jobs wait"
            slot.send_signal(signal.SIGCONT)
            (postgres,) = [p for p in supervisor.children() if p.name() == "postgres"]
            everything = [postgres, *postgres.children()]
            for process in everything:
                process.suspend()
            try:
                found = examined(running.url)
            finally:
                for process in everything:
                    process.resume()
            assert {"ready"} <= broken(found)
            assert "database" in found["ready"]["detail"]
        with running_service(folder, job_command=COMMAND, disk_reserve_bytes=reserve) as running:
            found = examined(running.url)
            assert broken(found) == {"upload"}
            with httpx.Client(base_url=running.url, timeout=60.0) as client:
                names = [item["name"] for item in client.get("/v1/datasets").json()["items"]]
            assert "biresnerf doctor" not in names


def _until(holds: Any) -> None:
    end = time.monotonic() + 60
    while not holds():
        assert time.monotonic() < end
        time.sleep(0.2)
