"""The proxy of compose.yaml: what deploy/proxy/start.sh decides, and what nginx itself refuses."""

from __future__ import annotations

import os
import re
import shutil
import socket
import subprocess
import time
from collections.abc import Iterator
from pathlib import Path

import pytest
import yaml

from tests.service.free_port import free_port
from tests.workers.conftest import short_folder

ROOT = Path(__file__).resolve().parents[2]
START = (ROOT / "deploy/proxy/start.sh").read_text()
TLS = yaml.safe_load((ROOT / "compose.tls.yaml").read_text())["services"]["proxy"]
NAMES = ("tls_certificate", "tls_key")


def started(modes: dict[str, int], asked: bool) -> tuple[int, str, str | None]:
    """Exit status, errors, and where nginx listens, or None where it did not start. The script is not run as root."""
    with short_folder() as folder:
        secrets, program = folder / "secrets", folder / "bin/nginx"
        for made in (secrets, program.parent, folder / "tmp"):
            made.mkdir(mode=0o755)
        (folder / "tmp").chmod(0o777)
        program.write_text("#!/bin/sh\ntouch " + str(folder / "tmp/started"))
        program.chmod(0o755)
        for name, mode in modes.items():
            (secrets / name).write_text("PEM")
            (secrets / name).chmod(mode)
        done = subprocess.run(
            ["sh", "-c", START.replace("/run/secrets", str(secrets)).replace("/tmp/", f"{folder}/tmp/")],
            env={
                "PATH": f"{program.parent}:{os.environ['PATH']}",
                **(TLS["environment"] if asked else {}),
            },
            user=65534 if os.geteuid() == 0 else None,
            capture_output=True,
            text=True,
        )
        listens = (folder / "tmp/listen.conf").read_text() if (folder / "tmp/started").exists() else None
        return done.returncode, done.stderr, listens


def test_without_tls_one_port_is_served():
    status, _, listens = started({}, asked=False)
    assert (status, listens) == (0, "listen 8080;\n")


def test_with_tls_the_plain_port_leads_to_it():
    status, _, listens = started(dict.fromkeys(NAMES, 0o444), asked=True)
    assert status == 0
    assert "listen 8443 ssl;" in listens
    assert "return 308 https://" in listens


@pytest.mark.parametrize("asked", [True, False], ids=["asked", "mounted"])
@pytest.mark.parametrize("lacks", NAMES)
def test_with_a_file_that_cannot_be_read_tls_is_no_plain_http(lacks, asked):
    status, said, listens = started({**dict.fromkeys(NAMES, 0o444), lacks: 0o000}, asked)
    stopped(status, said, listens, lacks)


@pytest.mark.parametrize("lacks", NAMES)
def test_with_a_file_that_is_not_there_tls_is_no_plain_http(lacks):
    stopped(*started({name: 0o444 for name in NAMES if name != lacks}, asked=True), lacks)


def stopped(status: int, said: str, listens: str | None, lacks: str) -> None:
    assert listens is None, "keys would go over the network in clear text"
    assert status != 0
    assert f"/{lacks}" in said
    assert "TLS" in said


def test_whoever_publishes_the_port_of_tls_asks_for_it():
    assert any(port.endswith(":8443") for port in TLS["ports"])
    assert TLS["environment"] == {"TLS": "required"}


@pytest.fixture
def nginx() -> Iterator[int]:
    """Port of nginx with nginx.conf, before a service that does not answer."""
    program = shutil.which("nginx")
    if program is None:
        pytest.skip("nginx is not installed")
    with short_folder() as folder:
        port, (tmp, conf) = free_port(), (folder / "tmp", folder / "nginx.conf")
        tmp.mkdir(mode=0o777)
        tmp.chmod(0o777)
        (tmp / "resolver.conf").write_text("resolver 127.0.0.1;")
        (tmp / "listen.conf").write_text(f"listen 127.0.0.1:{port};")
        text = (ROOT / "deploy/proxy/nginx.conf").read_text().replace("/tmp/", f"{tmp}/")
        conf.write_text(
            text.replace("set $service api;", "set $service 127.0.0.1;").replace(":8000", f":{free_port()}")
        )
        process = subprocess.Popen(
            [program, "-c", str(conf), "-g", "daemon off;"],
            stdout=subprocess.DEVNULL,
            stderr=subprocess.DEVNULL,
            user=65534 if os.geteuid() == 0 else None,
        )
        try:
            end = time.monotonic() + 30.0
            while not answered(port, 0):
                assert process.poll() is None
                assert time.monotonic() < end
                time.sleep(0.1)
            yield port
        finally:
            process.terminate()
            process.wait()


def answered(port: int, requests: int, address: str = "127.0.0.1") -> list[bytes]:
    """What comes back over one connection, head by head; a single b"" where ``requests`` is 0 and nginx is up."""
    try:
        connection = socket.create_connection(("127.0.0.1", port), 30.0, (address, 0))
    except OSError:
        return []
    with connection:
        if requests == 0:
            return [b""]
        connection.sendall(b"HEAD / HTTP/1.1\r\nHost: a\r\n\r\n" * (requests - 1))
        connection.sendall(b"HEAD / HTTP/1.1\r\nHost: a\r\nConnection: close\r\n\r\n")
        received = b"".join(iter(lambda: connection.recv(65536), b""))
    return re.split(rb"(?<=\r\n\r\n)(?=HTTP)", received)


def test_an_address_that_asks_without_end_is_told_to_wait_and_another_is_served(nginx):
    answers = answered(nginx, 900) + answered(nginx, 900)
    refused = [answer for answer in answers if answer.startswith(b"HTTP/1.1 429 ")]
    assert len(answers) == 1800
    assert not any(answer in refused for answer in answers[:500]), (
        "as many as a page of photos asks for at once"
    )
    assert len(refused) > 100
    assert b"application/problem+json" in refused[0]
    assert b"Retry-After" in refused[0]
    (other,) = answered(nginx, 1, "127.0.0.2")
    assert other.startswith(b"HTTP/1.1 503 ")
