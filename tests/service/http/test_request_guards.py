"""Requests refused before any route sees them, and what a link to a job opens; needs no database."""

from __future__ import annotations

import asyncio
import bisect
from typing import Any

import httpx
import pytest
from starlette.responses import PlainTextResponse

from service.http.hosts import is_host, is_public_name, on_loopback
from service.http.link_access import require_shown
from service.http.problems import ProblemError
from service.http.request_context import HEAD_BYTES_MAX, RequestContext

HOST = "poses.example:8000"


def refused(method: str = "POST", *, headers: Any = (), path: str = "/v1/jobs") -> str:
    """The code of the problem that the request gets; empty where it passes."""

    async def ask() -> httpx.Response:
        transport = httpx.ASGITransport(app=RequestContext(PlainTextResponse("passed")))
        async with httpx.AsyncClient(transport=transport, base_url=f"http://{HOST}") as client:
            return await client.request(method, path, headers=headers)

    answer = asyncio.run(ask())
    assert answer.headers["x-content-type-options"] == "nosniff"
    return "" if answer.text == "passed" else str(answer.json()["code"])


@pytest.mark.parametrize(
    "headers",
    [
        {"Sec-Fetch-Site": "cross-site"},
        {"Sec-Fetch-Site": "same-site"},
        {"Sec-Fetch-Site": "cross-site", "Origin": f"http://{HOST}"},
        *({"Origin": f"{text}"} for text in ("null", "http://[", f"//{HOST}", f"ftp://{HOST}")),
        *(
            {"Origin": f"http://{name}"}
            for name in ("poses.example", "poses.example:1", f"{HOST}.evil.example")
        ),
    ],
    ids=str,
)
def test_a_page_of_another_origin_may_look_and_change_nothing(headers: dict[str, str]):
    assert [refused(method, headers=headers) for method in ("POST", "PUT", "PATCH", "DELETE")] == [
        "cross_site"
    ] * 4
    assert refused("GET", headers=headers) == ""


@pytest.mark.parametrize(
    "headers",
    [
        {},
        {"Sec-Fetch-Site": "same-origin"},
        {"Sec-Fetch-Site": "none"},
        {"Origin": f"http://{HOST}"},
        {"Origin": f"https://{HOST}"},  # a proxy before us has TLS
    ],
    ids=str,
)
def test_our_own_page_and_programs_may_change_things(headers: dict[str, str]):
    assert refused(headers=headers) == ""


def test_what_a_proxy_may_read_differently_is_refused():
    both = {"Content-Length": "1", "Transfer-Encoding": "chunked"}
    two = [("Authorization", "Bearer brn_a"), ("Authorization", "Bearer brn_b")]
    for headers in (both, two, {"Host": "evil.example#127.0.0.1"}):
        assert refused(headers=headers) == "malformed_request"
    assert refused(headers={"Content-Encoding": "gzip"}) == "unsupported_media"
    assert refused(headers={"Content-Encoding": "identity"}) == ""


def test_a_head_may_be_as_large_as_the_limit_and_no_larger():
    def of(filling: int) -> str:
        return refused("GET", headers={"X": "x" * filling, "Host": HOST}, path="/" + "p" * 1000)

    fits = bisect.bisect_left(range(HEAD_BYTES_MAX), True, key=lambda filling: of(filling) != "")
    assert HEAD_BYTES_MAX - 1200 < fits < HEAD_BYTES_MAX - 1000
    assert of(fits) == "headers_too_large"


@pytest.mark.parametrize(
    "host",
    [
        "localhost",
        "127.0.0.1:8000",
        "[::1]:80",
        "web_1",
        "my-machine",
        "poses.example.org.",
        "3d.example.org",
    ],
)
def test_a_host_that_names_a_machine_is_one(host: str):
    assert is_host(host)


@pytest.mark.parametrize(
    "host",
    ["a@b", "[::1", "", "x/..", "a..b", "-a", "2130706433", "127.1", "1.2.3.256", "x" * 64, "[127.0.0.1]"],
)
def test_a_host_that_programs_read_differently_is_none(host: str):
    assert not is_host(host)


def test_loopback_is_this_machines_and_a_name_with_a_dot_may_be_anybodys():
    ours = ["localhost", "127.0.0.1", "127.8.9.10", "::1", "[::1]"]
    others = ["0.0.0.0", "::", "192.168.0.7", "localhost.evil.example", "127.0.0.1.evil.example", ""]
    assert [on_loopback(host) for host in (*ours, *others)] == [True] * 5 + [False] * 6
    public = ("evil.example", "192.168.0.7", "127.0.0.1.evil.example")
    assert not any(map(is_public_name, (*ours, "web")))
    assert all(map(is_public_name, public))


@pytest.mark.parametrize("method", ["GET", "HEAD"])
@pytest.mark.parametrize(
    "path", ["", "/artifacts", "/artifacts/a/b.ply", "/artifacts/log.txt.gz", "/report", "/link"]
)
def test_a_link_opens_its_job_to_read(method: str, path: str):
    require_shown("job_1", method, f"/v1/jobs/job_1{path}")


@pytest.mark.parametrize(
    ("method", "path"),
    [
        *(
            ("GET", f"/v1/jobs/job_1{rest}")
            for rest in ("0", "/", "/events", "/links", "/cancel", "/artifacts/log.txt")
        ),
        *(("GET", path) for path in ("/v1/jobs", "/v1/jobs/job_2", "/v1/datasets/job_1", "/x/v1/jobs/job_1")),
        *((method, "/v1/jobs/job_1") for method in ("POST", "DELETE", "PATCH", "OPTIONS")),
    ],
)
def test_a_link_opens_nothing_else(method: str, path: str):
    with pytest.raises(ProblemError) as caught:
        require_shown("job_1", method, path)
    assert caught.value.code == "not_found"
