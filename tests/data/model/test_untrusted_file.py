"""Strict JSON: any bytes give an object, or an error that says what to fix."""

from __future__ import annotations

import json
import math
import os

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from biresnerf.data.model.untrusted_file import MAX_TEXT_BYTES, first_non_finite, read_bytes, read_json_object
from biresnerf.errors import InputError
from tests.data.regex_steps import counted_steps
from tests.data.scenes import assert_complete

json_values = st.recursive(
    st.none() | st.booleans() | st.integers() | st.floats(allow_nan=False, allow_infinity=False) | st.text(),
    lambda inner: st.lists(inner, max_size=4) | st.dictionaries(st.text(), inner, max_size=4),
    max_leaves=20,
)


@pytest.fixture(scope="module")
def file(tmp_path_factory):
    return tmp_path_factory.mktemp("json") / "transforms.json"


def test_a_file_may_be_as_long_as_is_said_and_no_longer(tmp_path):
    path = tmp_path / "images.bin"
    path.write_bytes(b"x" * 1000)
    assert read_bytes(path, 1000) == b"x" * 1000
    with pytest.raises(InputError) as caught:
        read_bytes(path, 999)
    assert_complete(caught.value, "pose_file_invalid")


@settings(max_examples=200, deadline=None)
@given(st.dictionaries(st.text(), json_values, max_size=5))
def test_any_finite_object_reads_back_equal(file, document):
    file.write_text(json.dumps(document, ensure_ascii=False), "utf-8", errors="replace")
    expected = json.loads(file.read_text("utf-8"))
    assert read_json_object(file) == expected


@settings(max_examples=300, deadline=None)
@given(
    st.binary(max_size=200)
    | st.text(alphabet='{}[]",:0123456789eE.-+ntfINa\\u ', max_size=60).map(str.encode)
)
def test_any_bytes_give_an_object_or_a_complete_error(file, content):
    file.write_bytes(content)
    try:
        assert isinstance(read_json_object(file), dict)
    except InputError as error:
        assert_complete(error, error.code, "transforms.json")


def test_a_byte_order_mark_is_read_over(file):
    file.write_bytes(b"\xef\xbb\xbf" + b'{"frames": []}')
    assert read_json_object(file) == {"frames": []}


@pytest.mark.parametrize(
    ("text", "code", "words"),
    [
        ('{"a": 1, "frames": [', "pose_file_invalid", "line 1"),
        ("", "pose_file_invalid", "line 1"),
        ('{"a": 1, "a": 2}', "pose_file_invalid", "'a'"),
        ('{"frames": [{"file_path": "x.png", "k1": 1, "k1": 2}]}', "pose_file_invalid", "'x.png'"),
        ("[1, 2]", "pose_file_invalid", "list"),
        ('{"a": NaN}', "pose_not_finite", "NaN"),
        ('{"a": [0, {"b": -Infinity}]}', "pose_not_finite", "infinite"),
        ('{"a": 1e999}', "pose_not_finite", "infinite"),
        ("[" * 100_000, "pose_file_invalid", "deeply"),
        ('{"a": ' + "9" * 5000 + "}", "pose_file_invalid", "digit"),
    ],
)
def test_broken_json_is_refused_with_the_place(file, text, code, words):
    file.write_text(text, "utf-8")
    with pytest.raises(InputError) as caught:
        read_json_object(file)
    assert_complete(caught.value, code, "transforms.json")
    assert words in caught.value.detail


def test_other_encodings_are_refused(file):
    file.write_bytes('{"a": "é"}'.encode("latin-1"))
    with pytest.raises(InputError, match="UTF-8"):
        read_json_object(file)


def test_a_file_beyond_the_limit_is_not_even_read(file):
    file.write_text('{"a": 1}')
    os.truncate(file, MAX_TEXT_BYTES + 1)
    with pytest.raises(InputError) as caught:
        read_json_object(file)
    assert_complete(caught.value, "pose_file_invalid", "transforms.json")


def test_the_first_number_that_is_not_finite_is_named_by_its_path():
    document = {"a": 1, "frames": [{"m": [[0.0, 1.0]]}, {"m": [[0.0, math.nan]]}]}
    assert first_non_finite(document) == ".frames[1].m[0][1]"
    assert first_non_finite({"a": [1.0, "NaN"]}) is None


LONG = {
    "a string without end in a file with comments": lambda n: '{"a": 1 // b\n "' + '\\"' * n,
    "comments without end": lambda n: "{" + "/* " * n,
}


@pytest.mark.parametrize("case", LONG)
def test_the_work_on_a_file_grows_as_its_size(file, case, monkeypatch):
    def read(size):
        file.write_text(LONG[case](size), "utf-8")
        read_json_object(file)

    counted_steps(monkeypatch).assert_grow_as_size(read, 300)


def test_a_long_key_above_many_numbers_is_written_out_for_the_one_that_is_not_finite():
    class Key(str):
        written = 0

        def __format__(self, how):
            Key.written += 1
            return super().__format__(how)

    numbers = [0.5] * 1000
    assert first_non_finite({Key("k"): numbers}) is None
    assert Key.written == 0
    assert first_non_finite({Key("k"): [*numbers, math.nan]}) == ".k[1000]"
    assert Key.written == 1


def test_an_error_repeats_no_more_than_the_start_of_what_it_names(file):
    for text in ('{"%s": 1, "%s": 2}' % (("k" * 10**6,) * 2), '{"%s": NaN}' % ("k" * 10**6)):
        file.write_text(text)
        with pytest.raises(InputError) as caught:
            read_json_object(file)
        assert len(caught.value.detail + caught.value.where) < 1000
