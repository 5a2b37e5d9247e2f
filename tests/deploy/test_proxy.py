"""The proxy of compose.yaml: what deploy/proxy/start.sh decides. `make compose-check` runs it with nginx."""

from __future__ import annotations

import os
import subprocess
from pathlib import Path

import pytest
import yaml

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
