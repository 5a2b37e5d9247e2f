"""The service's log of a request: enough for an audit, but no secrets."""

from __future__ import annotations

import re
import socket
import time

import httpx
import pytest

from tests.service.conftest import Running, new_dataset


def line_of(service: Running, request_id: str) -> str:
    """The one line about the request, which may be written a moment after its answer was read."""
    end = time.monotonic() + 10
    while True:
        found = [line for line in service.log.read_text().splitlines() if f"request_id={request_id}" in line]
        if found or time.monotonic() > end:
            (line,) = found
            return line
        time.sleep(0.05)


def test_a_request_is_logged_with_who_what_and_how_it_was_answered(
    service: Running, http: httpx.Client
) -> None:
    dataset = new_dataset(http)
    http.delete(f"/v1/datasets/{dataset}?token=do-not-tell", headers={"X-Request-ID": "audit-1"})
    line = line_of(service, "audit-1")
    assert f" api INFO DELETE /v1/datasets/{dataset} 204 [" in line
    for said in ("client=127.0.0.1", "tenant=local", "route=/v1/datasets/{dataset_id}", "sent=0"):
        assert said in line
    assert re.search(r"ms=\d", line)
    assert "do-not-tell" not in line


def test_a_path_cannot_forge_a_line(service: Running, http: httpx.Client) -> None:
    http.get(
        "/v1/x%0A2026-01-01T00:00:00.000Z%20api%20INFO%20forged%1b[2J", headers={"X-Request-ID": "audit-2"}
    )
    line = line_of(service, "audit-2")
    assert r"/v1/x\n2026-01-01T00:00:00.000Z api INFO forged\x1b[2J 404" in line
    assert not [line for line in service.log.read_text().splitlines() if "INFO forged" in line[:50]]


def test_probes_are_logged_only_when_they_fail(service: Running, http: httpx.Client) -> None:
    http.get("/livez", headers={"X-Request-ID": "audit-3"})
    http.get("/livez/", headers={"X-Request-ID": "audit-4"})
    line_of(service, "audit-4")
    assert "audit-3" not in service.log.read_text()


FORM = "multipart/form-data; boundary=b"
CUT_OFF = {
    "a file": ("PUT", "/v1/datasets/{}/files/a", "application/octet-stream", b"x"),
    "an archive": ("POST", "/v1/datasets/{}/archive", "application/zip", b"PK"),
    "JSON": ("POST", "/v1/datasets", "application/json", b"{"),
    "a form": ("POST", "/v1/jobs", FORM, b'--b\r\nContent-Disposition: form-data; name="archive"\r\n\r\nPK'),
}


@pytest.mark.parametrize("body", CUT_OFF)
def test_a_client_that_goes_away_in_mid_body_is_one_line_and_no_fault_of_ours(
    service: Running, http: httpx.Client, body: str
) -> None:
    method, path, kind, sent = CUT_OFF[body]
    identity = f"gone-{list(CUT_OFF).index(body)}"
    head = (
        f"{method} {path.format(new_dataset(http))} HTTP/1.1\r\nHost: x\r\nX-Request-ID: {identity}\r\n"
        f"Content-Type: {kind}\r\nContent-Length: 1000\r\n\r\n"
    )
    address = http.base_url.host, http.base_url.port
    with socket.create_connection(address, timeout=10) as line:
        line.sendall(head.encode() + sent)
        time.sleep(0.3)
    assert " 499 [" in line_of(service, identity)
    assert f"{identity} {method}" not in service.log.read_text(), "no traceback follows"
    assert 'status="500"' not in http.get("/metrics").text
