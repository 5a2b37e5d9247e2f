"""JSON that two programs may read differently is refused."""

from __future__ import annotations

import pytest

from service.http.problems import ProblemError
from service.intake.json_body import load_json


@pytest.mark.parametrize(
    "text",
    [
        '{"a": 1, "a": 2}',
        '{"b": [{"a": 1, "a": 1}]}',
        *("NaN", "[Infinity]", "[-Infinity]", "", "{", '{"a": 1} x', "[" * 100_000),
    ],
    ids=lambda text: text[:20],
)
def test_ambiguous_or_broken_json_is_refused(text: str):
    with pytest.raises(ProblemError) as caught:
        load_json(text)
    assert caught.value.code == "malformed_json"


def test_plain_json_is_read():
    assert load_json(b'{"a": {"a": [1, 1, 2.5, null]}}') == {"a": {"a": [1, 1, 2.5, None]}}
