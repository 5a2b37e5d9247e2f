from __future__ import annotations

import asyncio
import itertools
from collections.abc import AsyncGenerator, AsyncIterator
from pathlib import Path

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from starlette.requests import Request
from starlette.types import Message

from service.http.problems import ProblemError
from service.intake.one_shot import read_form
from service.intake.uploads import capped, limited_body


async def pieces(content: bytes, cuts: list[int]) -> AsyncGenerator[bytes, None]:
    edges = [0, *sorted(cut % (len(content) + 1) for cut in cuts), len(content)]
    for start, end in itertools.pairwise(edges):
        yield content[start:end]


def test_a_body_that_stands_still_is_given_up() -> None:
    async def stalled() -> AsyncIterator[bytes]:
        yield b"x"
        await asyncio.sleep(30)
        yield b"y"

    async def read() -> None:
        async for _ in capped(stalled(), 100, idle_s=0.05):
            pass

    with pytest.raises(ProblemError) as caught:
        asyncio.run(read())
    assert (caught.value.status, caught.value.code) == (408, "body_timeout")


def test_a_body_that_says_it_is_too_large_is_refused_before_a_byte_of_it_is_read() -> None:
    async def unread() -> Message:
        raise AssertionError("a byte was asked for")

    def announced(size: int) -> Request:
        return Request({"type": "http", "headers": [(b"content-length", str(size).encode())]}, unread)

    limited_body(announced(100), 100)
    with pytest.raises(ProblemError) as caught:
        limited_body(announced(101), 100)
    assert caught.value.code == "body_too_large"


@given(st.binary(max_size=200), st.lists(st.integers(0, 500), max_size=6), st.integers(0, 250))
def test_a_stream_passes_whole_up_to_the_limit_and_never_beyond(
    content: bytes, cuts: list[int], limit: int
) -> None:
    passed = bytearray()

    async def read() -> None:
        async for chunk in capped(pieces(content, cuts), limit):
            passed.extend(chunk)

    if len(content) > limit:
        with pytest.raises(ProblemError):
            asyncio.run(read())
        assert len(passed) <= limit
    else:
        asyncio.run(read())
        assert bytes(passed) == content


@settings(deadline=None)
@given(
    archive=st.binary(max_size=400),
    text=st.text(max_size=50),
    cuts=st.lists(st.integers(0, 2000), max_size=8),
)
def test_a_form_is_read_the_same_however_it_is_cut(
    tmp_path_factory: pytest.TempPathFactory, archive: bytes, text: str, cuts: list[int]
) -> None:
    target = tmp_path_factory.mktemp("form") / "archive"
    head = '--b0und\r\nContent-Disposition: form-data; name="{}"{}\r\n\r\n'
    body = head.format("options", "").encode() + text.encode() + b"\r\n"
    body += head.format("archive", '; filename="a.zip"').encode() + archive + b"\r\n--b0und--\r\n"
    if b"--b0und" in archive + text.encode():
        return
    texts = asyncio.run(read_form("multipart/form-data; boundary=b0und", pieces(body, cuts), target))
    assert (texts, target.read_bytes()) == ({"options": text}, archive)


@pytest.mark.parametrize(
    ("body", "code"),
    [
        (b"", "malformed_body"),
        (b"no form", "malformed_body"),
        (b'--b\r\nContent-Disposition: form-data; name="archive"; filename="a"\r\n\r\n12', "malformed_body"),
        (
            b'--b\r\nContent-Disposition: form-data; name="options"\r\n\r\n\xff\r\n--b--\r\n',
            "invalid_request",
        ),
        (b'--b\r\nContent-Disposition: form-data; name="x"\r\n\r\n1\r\n--b--\r\n', "invalid_request"),
        (b"--b\r\nX: " + b"y" * 20_000 + b"\r\n\r\n1\r\n--b--\r\n", "malformed_body"),
        (
            b'--b\r\nContent-Disposition: form-data; name="options"\r\n\r\n' + b"1" * 300_000,
            "malformed_body",
        ),
        (
            2 * b'--b\r\nContent-Disposition: form-data; name="options"\r\n\r\n1\r\n' + b"--b--\r\n",
            "invalid_request",
        ),
    ],
)
def test_a_bad_form_is_a_problem(tmp_path: Path, body: bytes, code: str) -> None:
    with pytest.raises(ProblemError) as caught:
        asyncio.run(read_form("multipart/form-data; boundary=b", pieces(body, []), tmp_path / "archive"))
    assert caught.value.code == code
