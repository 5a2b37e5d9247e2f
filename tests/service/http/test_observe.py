"""What the log of the service tells of a request: enough for an audit, nothing that is secret."""

from __future__ import annotations

import re
import time

import httpx

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
