from __future__ import annotations

import pytest
from hypothesis import given
from hypothesis import strategies as st

from service.http.http_conditionals import byte_range, none_match
from service.http.problems import ProblemError


@pytest.mark.parametrize(
    ("header", "part"),
    [
        ("bytes=0-0", (0, 0)),
        ("bytes=2-5", (2, 5)),
        ("bytes=7-", (7, 9)),
        ("bytes=7-99", (7, 9)),
        ("bytes=-3", (7, 9)),
        ("bytes=-99", (0, 9)),
        ("BYTES=1-2", (1, 2)),
        (None, None),
        ("lines=1-2", None),
        ("bytes=0-1,4-5", None),
    ],
)
def test_a_range_names_these_bytes_of_ten(header: str | None, part: tuple[int, int] | None) -> None:
    assert byte_range(header, None, '"e"', 10) == part


@pytest.mark.parametrize("header", ["bytes=10-", "bytes=99-100", "bytes=-0"])
def test_a_range_beyond_the_end_is_416_with_the_size(header: str) -> None:
    with pytest.raises(ProblemError) as caught:
        byte_range(header, None, '"e"', 10)
    assert caught.value.status == 416
    assert caught.value.response_headers()["Content-Range"] == "bytes */10"


def test_an_empty_file_satisfies_no_range() -> None:
    with pytest.raises(ProblemError, match="0 bytes"):
        byte_range("bytes=0-", None, '"e"', 0)


@given(st.text(max_size=30), st.integers(0, 1000))
def test_any_range_header_gives_bytes_of_the_file_or_a_problem(spec: str, size: int) -> None:
    try:
        part = byte_range(f"bytes={spec}", None, '"e"', size)
    except ProblemError:
        return
    assert part is None or 0 <= part[0] <= part[1] < size


def test_a_stale_if_range_gets_the_whole_file() -> None:
    assert byte_range("bytes=1-2", '"old"', '"new"', 10) is None
    assert byte_range("bytes=1-2", '"new"', '"new"', 10) == (1, 2)
    assert byte_range("bytes=1-2", 'W/"new"', '"new"', 10) is None  # a weak tag proves nothing about bytes


def test_if_none_match_compares_weakly_over_a_list() -> None:
    assert none_match(None, '"a"')
    assert none_match('"b", W/"c"', '"a"')
    assert not none_match('"b", W/"a"', '"a"')
    assert not none_match('"a"', 'W/"a"')
    assert not none_match("*", '"a"')
    assert none_match("a", '"a"')
