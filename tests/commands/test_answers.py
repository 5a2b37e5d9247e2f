"""What commands print, and the option values they read."""

from __future__ import annotations

import json
import math

import pytest

from biresnerf.commands.answers import print_json, table, with_code
from biresnerf.commands.settings_option import parse_duration, parse_settings
from biresnerf.errors import InputError
from biresnerf.wire.results import ArtifactView

FILE = ArtifactView(name="ä", size=1, sha256="0" * 64, media_type="x/y", href="/a")


def test_what_is_printed_as_json_is_json(capsys: pytest.CaptureFixture[str]) -> None:
    print_json({"a": math.nan, "b": [1.0, -math.inf, (math.inf, "ä")], "c": {"d": FILE}})
    text = capsys.readouterr().out
    assert "NaN" not in text
    assert "ä" in text
    found = json.loads(text)
    assert (found["a"], found["b"], found["c"]["d"]["name"]) == (None, [1.0, None, [None, "ä"]], "ä")
    for several in ([FILE], (FILE,)):
        print_json(several)
        assert json.loads(capsys.readouterr().out) == [FILE.model_dump(mode="json")]


def test_columns_are_as_wide_as_their_widest_cell() -> None:
    assert table([("a", "b", "c"), ("long", "", "x")]) == "a     b  c\nlong     x"
    assert table([]) == ""


def test_an_error_is_followed_by_its_code() -> None:
    error = InputError("bad_file", "is bad.", where="x.png", hint="Remove it.")
    assert with_code(error) == "x.png: is bad. Remove it. [bad_file]"
    assert with_code(OSError("disk full")) == "disk full"


def test_a_setting_is_json_where_it_can_be_and_else_text() -> None:
    given = parse_settings(("steps=20", "fixed=[1]", "start=auto", "a=", 'b="1"', "c=x=y", "d=true"))
    assert given == {"steps": 20, "fixed": [1], "start": "auto", "a": "", "b": "1", "c": "x=y", "d": True}
    assert parse_settings(("exports=kitti, bundler", "fixed=a")) == {
        "exports": ["kitti", "bundler"],
        "fixed": ["a"],
    }


@pytest.mark.parametrize("texts", [("steps",), ("=1",), ("a=1", "a=2")])
def test_a_setting_that_is_none_or_is_there_twice_is_refused(texts: tuple[str, ...]) -> None:
    with pytest.raises(InputError) as caught:
        parse_settings(texts)
    assert (caught.value.code, caught.value.where) == ("invalid_options", "--set")


@pytest.mark.parametrize(
    ("text", "seconds"), [("90", 90), ("90s", 90), ("2m", 120), ("1.5m", 90), ("1h30m", 5400), ("1m5", 65)]
)
def test_a_time_has_hours_minutes_and_seconds(text: str, seconds: float) -> None:
    assert parse_duration(text) == seconds


@pytest.mark.parametrize("text", ["", "soon", "-5", "0", "2 m", "1.2.3s", "5d"])
def test_what_is_no_time_is_refused(text: str) -> None:
    with pytest.raises(InputError) as caught:
        parse_duration(text)
    assert (caught.value.code, caught.value.where) == ("invalid_options", "--budget")
