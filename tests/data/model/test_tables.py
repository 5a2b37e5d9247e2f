"""Tables of unknown origin: where the head is, what rows say, and which cannot be used."""

from __future__ import annotations

import pytest

from biresnerf.data.model.untrusted_file import HEAD_LINES, read_table
from biresnerf.errors import InputError
from tests.data.scenes import assert_complete

TITLES = {"name": ("label", "(image)?name"), "x": ("x",)}


def table(lines):
    return read_table("t.csv", lines, TITLES, lambda found: len(found) == len(TITLES))


def test_a_table_has_its_rows_below_its_head_without_blank_lines_and_comments():
    found = table(["# of 2026", "Image Name; X ;note", "", 'a.png; 1;"so; said"', "# the end", "b.png"])
    assert found.head == "t.csv line 2"
    assert [where for where, _ in found.rows] == ["t.csv line 4", "t.csv line 6"]
    assert [[found.cell(row, key) for key in TITLES] for _, row in found.rows] == [
        ["a.png", "1"],
        ["b.png", ""],
    ]
    assert found.numbers(found.rows[0][1], ["x"], "t.csv line 4", "") == [1.0]
    with pytest.raises(InputError) as caught:
        found.numbers(found.rows[1][1], ["x"], "t.csv line 6", "Add x.")
    assert_complete(caught.value, "pose_file_invalid", "t.csv line 6")


def test_of_two_columns_of_one_meaning_the_preferred_one_is_read():
    found = table(["name,x,label", "a,1,b"])
    assert found.cell(found.rows[0][1], "name") == "b"


def test_a_head_is_looked_for_in_the_first_lines_alone():
    assert table([*["1,2"] * (HEAD_LINES - 1), "name,x"]) is not None
    assert table([*["1,2"] * HEAD_LINES, "name,x"]) is None
