from __future__ import annotations

import posixpath
import unicodedata

import pytest
from hypothesis import given
from hypothesis import strategies as st

from biresnerf.errors import InputError
from biresnerf.wire.safe_paths import PART_BYTES_MAX, NameSet, checked_path, is_litter

PIECES = st.sampled_from(
    ["a", "ä", "..", ".", "", "/", "\\", "C:", "\0", "\n", "\u2028", "\ud800", "img 1.png", "~"]
)


NAMES = st.one_of(
    st.text(max_size=300),
    st.lists(st.sampled_from(["a", "..", ".", "b.png"]), max_size=5).map("/".join),
    st.lists(PIECES, max_size=8).map("/".join),
    st.lists(PIECES, max_size=8).map("".join),
)


@given(NAMES)
def test_what_passes_stays_below_the_folder_and_is_its_own_normal_form(name: str) -> None:
    try:
        path = checked_path(name)
    except InputError:
        return
    inside = posixpath.normpath(posixpath.join("/root/folder", path))
    assert inside == f"/root/folder/{path}"
    assert checked_path(path) == path
    assert all(0 < len(part.encode()) <= PART_BYTES_MAX for part in path.split("/"))
    assert not any(unicodedata.category(char).startswith("Cc") for char in path)


@pytest.mark.parametrize("name", ["C:", "./C:", "././c:/a.png"])
def test_a_drive_letter_is_refused_wherever_it_would_end_up_first(name: str) -> None:
    with pytest.raises(InputError, match="drive letter"):
        checked_path(name)


def test_the_names_of_real_sets_pass() -> None:
    for name in (
        "images/0001.png",
        "train/r_0.png",
        "Blick über «Dach» (2).jpg",
        "a..b.png",
        "...",
        "日本/写真.jpg",
    ):
        assert checked_path(name) == name
    assert checked_path("./train/./r_0.png") == "train/r_0.png"


@given(st.lists(st.text("abABéÉ", min_size=1, max_size=3), min_size=1, max_size=8))
def test_a_set_of_names_holds_no_two_that_are_equal_folded(names: list[str]) -> None:
    taken, kept = NameSet(), []
    for name in names:
        for form in ("NFC", "NFD"):
            spelled = unicodedata.normalize(form, name)
            try:
                taken.add(spelled)
            except InputError:
                continue
            kept.append(unicodedata.normalize("NFC", spelled.casefold()))
    assert len(kept) == len(set(kept))


@pytest.mark.parametrize("names", [("a", "a/b"), ("a/b", "a"), ("A/b", "a"), ("a", "A/b"), ("a/b/c", "a/B")])
def test_no_file_has_the_name_of_a_folder(names: tuple[str, str]) -> None:
    taken = NameSet()
    taken.add(names[0])
    with pytest.raises(InputError) as caught:
        taken.add(names[1])
    assert caught.value.code == "name_collision"


def test_one_folder_takes_many_files() -> None:
    taken = NameSet()
    taken.add("a/b/1")
    taken.add("a/b/2")
    taken.add("a/c")
    with pytest.raises(InputError, match="equal but for case"):
        taken.add("a/B/3")


def test_litter_is_told_from_data() -> None:
    assert all(is_litter(path) for path in ("__MACOSX/a/._b.png", "a/._b.png", "a/.DS_Store", "Thumbs.db"))
    assert not any(is_litter(path) for path in ("a/b.png", "_MACOSX/b.png", "a._b.png"))
