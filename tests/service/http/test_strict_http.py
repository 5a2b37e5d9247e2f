"""Malformed and malicious requests, byte by byte over a socket."""

from __future__ import annotations

import contextlib
import json
import socket
import time
from typing import Any

import h11
import httpx
import pytest

from service.http import strict_http
from tests.service.conftest import Running, new_dataset


def answers_to(
    service: Running, sent: bytes, patience_s: float = 10.0
) -> list[tuple[int, dict[str, str], bytes]]:
    """Every answer on one connection, until the service closes it or falls silent."""
    host, port = service.url.removeprefix("http://").split(":")
    came = b""
    with socket.create_connection((host, int(port)), timeout=patience_s) as line:
        with contextlib.suppress(ConnectionError, TimeoutError):
            line.sendall(sent)
            line.shutdown(socket.SHUT_WR)
        with contextlib.suppress(ConnectionError, TimeoutError):
            while chunk := line.recv(65536):
                came += chunk
    found = []
    while came.startswith(b"HTTP/1.1 "):
        head, _, rest = came.partition(b"\r\n\r\n")
        status, *lines = head.decode("latin-1").split("\r\n")
        headers = {name.lower(): value for name, _, value in (line.partition(": ") for line in lines)}
        length = int(headers.get("content-length", len(rest)))
        found.append((int(status.split()[1]), headers, rest[:length]))
        came = rest[length:]
    assert not came
    return found


def refused(answers: list[tuple[int, dict[str, str], bytes]], status: int, code: str) -> dict[str, Any]:
    """The one answer on the connection, once it has been seen to be this problem, and nothing after it."""
    ((seen, headers, body),) = answers
    problem = json.loads(body)
    assert (seen, problem["code"]) == (status, code)
    assert headers["content-type"] == "application/problem+json"
    assert headers["x-request-id"] == problem["request_id"]
    assert headers["connection"] == "close"
    return problem


HOST = b"Host: x\r\n"
GET = b"GET /livez HTTP/1.1\r\n"
MALFORMED = {
    "not HTTP": b"\x16\x03\x01\x02\x00\x01\x00\x01\xfc\x03\x03" + bytes(40) + b"\r\n\r\n",
    "no version": b"GET /livez\r\n\r\n",
    "HTTP/2 without the upgrade": b"PRI * HTTP/2.0\r\n\r\nSM\r\n\r\n",
    "no Host": GET + b"\r\n",
    "two Hosts": GET + HOST + b"Host: y\r\n\r\n",
    "two lengths": b"POST /v1/datasets HTTP/1.1\r\n"
    + HOST
    + b"Content-Length: 2\r\nContent-Length: 40\r\n\r\n{}",
    "two equal lengths": b"POST /v1/datasets HTTP/1.1\r\n"
    + HOST
    + b"Content-Length: 2\r\ncontent-length: 2\r\n\r\n{}",
    "two equal lengths in one header": b"POST /v1/datasets HTTP/1.1\r\n"
    + HOST
    + b"Content-Length: 2, 2\r\n\r\n{}",
    "line feeds alone": b"GET /livez HTTP/1.1\nHost: x\n\n",
    "a line feed alone after a header": GET + b"Host: x\nX-A: b\r\n\r\n",
    "a line feed alone at the end of the head": GET + HOST + b"\n",
    "a header folded over two lines": GET + HOST + b"X-A: b\r\n c\r\n\r\n",
    "negative length": b"POST /v1/datasets HTTP/1.1\r\n" + HOST + b"Content-Length: -1\r\n\r\n",
    "signed length": b"POST /v1/datasets HTTP/1.1\r\n" + HOST + b"Content-Length: +2\r\n\r\n{}",
    "length in hexadecimal": b"POST /v1/datasets HTTP/1.1\r\n" + HOST + b"Content-Length: 0x2\r\n\r\n{}",
    "a length of 40 digits": b"POST /v1/datasets HTTP/1.1\r\n"
    + HOST
    + b"Content-Length: "
    + b"9" * 40
    + b"\r\n\r\n",
    "unknown transfer coding": b"POST /v1/datasets HTTP/1.1\r\n"
    + HOST
    + b"Transfer-Encoding: xchunked\r\n\r\n0\r\n\r\n",
    "two transfer codings": b"POST /v1/datasets HTTP/1.1\r\n"
    + HOST
    + b"Transfer-Encoding: gzip, chunked\r\n\r\n0\r\n\r\n",
    "a chunk size that is not a number": b"POST /v1/datasets HTTP/1.1\r\n"
    + HOST
    + b"Content-Type: application/json\r\nTransfer-Encoding: chunked\r\n\r\nzz\r\n{}\r\n0\r\n\r\n",
    "space before the colon": GET + HOST + b"X-A : b\r\n\r\n",
    "NUL in a header": GET + HOST + b"X-A: b\0c\r\n\r\n",
    "carriage return alone in a header": GET + HOST + b"X-A: b\rX-B: c\r\n\r\n",
    "space in the target": b"GET /li vez HTTP/1.1\r\n" + HOST + b"\r\n",
    "bytes beyond ASCII in the target": "GET /lívez HTTP/1.1\r\n".encode() + HOST + b"\r\n",
    "control character in the method": b"G\x01T /livez HTTP/1.1\r\n" + HOST + b"\r\n",
}


@pytest.mark.parametrize("case", MALFORMED)
def test_what_is_not_http_is_refused_and_the_connection_closed(
    service: Running, http: httpx.Client, case: str
) -> None:
    # A second request follows, as a smuggler would send it: it must not be answered.
    smuggled = b"DELETE /v1/jobs/job_1 HTTP/1.1\r\nHost: x\r\n\r\n"
    refused(answers_to(service, MALFORMED[case] + smuggled), 400, "malformed_request")


def test_a_body_with_two_lengths_is_refused_and_nothing_after_it_is_a_request(
    service: Running, http: httpx.Client
) -> None:
    inner = b"GET /livez HTTP/1.1\r\nHost: x\r\n\r\n"
    sent = b"POST /v1/datasets HTTP/1.1\r\n" + HOST + b"Content-Type: application/json\r\n"
    sent += b"Transfer-Encoding: chunked\r\nContent-Length: 5\r\n\r\n0\r\n\r\n" + inner
    refused(answers_to(service, sent), 400, "malformed_request")


@pytest.mark.parametrize(
    "head",
    [
        GET + HOST + b"X-A: " + b"a" * 40_000 + b"\r\n\r\n",
        GET + HOST + b"".join(b"X-%d: a\r\n" % number for number in range(5000)) + b"\r\n",
        b"GET /" + b"a" * 40_000 + b" HTTP/1.1\r\n" + HOST + b"\r\n",
        GET + HOST + b"X-A: " + b"a" * 40_000,
    ],
    ids=["one header", "many headers", "target", "without an end"],
)
def test_a_head_too_large_is_431(service: Running, http: httpx.Client, head: bytes) -> None:
    assert "32768" in refused(answers_to(service, head), 431, "headers_too_large")["detail"]


def test_line_feeds_alone_are_refused_in_heads_only(http: httpx.Client) -> None:
    body = b'{\n \n\n "name": "x"\n}\n'
    assert (
        http.post("/v1/datasets", content=body, headers={"Content-Type": "application/json"}).status_code
        == 201
    )


def test_requests_in_a_row_on_one_connection_are_answered_in_turn(
    service: Running, http: httpx.Client
) -> None:
    one = GET + HOST + b"\r\n"
    last = GET + HOST + b"Connection: close\r\n\r\n"
    assert [status for status, _, _ in answers_to(service, one + one + last)] == [200, 200, 200]


ODD = {
    "Range": ("bytes=0-" + "9" * 400, {415}),
    "Content-Type": ("multipart/form-data; boundary=" + "b" * 500, {415}),
    "Idempotency-Key": ("\x7f" * 300, {400, 415, 422}),
    "Last-Event-ID": ("१२", {415, 422}),
    "Authorization": ("Bearer " + "=" * 1000, {401, 415, 422}),
    "X-Request-ID": ("../../x\u00e9", {415}),
    "Accept-Language": ("\u00ff" * 1000, {415}),
    "X-Forwarded-For": ("127.0.0.1, ::1" * 50, {415}),
    "Forwarded": ('for=_;proto=https;by="', {415}),
    "X-HTTP-Method-Override": ("DELETE", {415}),
    "Upgrade": ("websocket", {415}),
    "Expect": ("200-maybe", {415}),
    "Cookie": ("a=b; " * 1000 + "c", {415}),
}


@pytest.mark.parametrize("name", ODD)
def test_an_odd_header_changes_nothing_or_is_a_problem(http: httpx.Client, name: str) -> None:
    value, allowed = ODD[name]
    headers = [(name.encode(), value.encode("utf-8")), (b"connection", b"close")]
    answer = http.post("/v1/datasets", content=b"<xml/>", headers=headers)
    assert answer.status_code in allowed, answer.text
    assert answer.headers["content-type"] == "application/problem+json"
    assert answer.headers["x-request-id"].isascii()
    assert ".." not in answer.headers["x-request-id"]


def test_a_body_cut_off_within_a_chunk_leaves_nothing(service: Running, http: httpx.Client) -> None:
    dataset = new_dataset(http)
    sent = f"POST /v1/datasets/{dataset}/archive HTTP/1.1\r\nHost: x\r\nTransfer-Encoding: chunked\r\n\r\n".encode()
    answers_to(service, sent + b"ffff\r\nPK\x03\x04")
    end = time.monotonic() + 10
    while not service.staging_is_empty():
        assert time.monotonic() < end
        time.sleep(0.05)
    assert http.get(f"/v1/datasets/{dataset}").json()["files"] == 0


def test_more_headers_than_anybody_sends_are_refused(service: Running) -> None:
    def asking(count: int) -> bytes:
        return GET + HOST + b"".join(b"X-%d: y\r\n" % number for number in range(count - 1)) + b"\r\n"

    (most,) = answers_to(service, asking(100))
    assert most[0] == 200
    (more,) = answers_to(service, asking(101))
    assert more[0] == 431


@pytest.mark.parametrize(
    "lines",
    [
        b"X: a\n",
        b"X: a\r\n b\r\n",
        b"Content-Length: 1\r\nContent-Length: 1\r\n",
        b"Content-Length: 1, 1\r\n",
        b"X: a\r\n" * strict_http.HEADERS_MAX,
    ],
)
def test_a_head_that_another_program_may_read_differently_is_refused(lines: bytes) -> None:
    strict_http._Head().read(GET + HOST + b"Content-Length: 1\r\n\r\nX: a\n b\n")
    with pytest.raises(h11.RemoteProtocolError):
        strict_http._Head().read(GET + HOST + lines + b"\r\n")


def test_each_byte_of_a_head_that_comes_byte_by_byte_is_searched_once() -> None:
    class Received(bytes):
        searched = 0

        def find(self, what: bytes, start: int = 0) -> int:
            Received.searched += len(self) - start
            return super().find(what, start)

    text = GET + HOST + b"X-A: b\r\n" * 90
    head = strict_http._Head()
    for length in range(1, len(text) + 1):
        head.read(Received(text[:length]))
    assert head.lines == text.count(b"\n")
    assert Received.searched <= 2 * len(text)


def test_heads_of_one_connection_are_each_read_from_their_start(service: Running) -> None:
    one = GET + HOST + b"Content-Length: 0\r\n"
    found = answers_to(service, 3 * (one + b"\r\n") + one + b"Content-Length: 0\r\n\r\n")
    assert [answer[0] for answer in found] == [200, 200, 200, 400]
