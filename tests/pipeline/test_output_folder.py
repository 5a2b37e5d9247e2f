"""A run removes from its output folder only what a finished run wrote there, never the user's files."""

from __future__ import annotations

from pathlib import Path

import pytest

from biresnerf.errors import InputError
from biresnerf.stages import CHECKPOINT
from biresnerf.write.output_folder import REPORT, OutputFolder


def folder_of_the_user(path: Path) -> set[Path]:
    for name in (
        "transforms.json",
        "colmap/sparse/0/cameras.txt",
        "renders/mine.png",
        CHECKPOINT.parent / "notes.txt",
    ):
        (path / name).parent.mkdir(parents=True, exist_ok=True)
        (path / name).write_text("the user's own")
    return set(path.rglob("*"))


def test_nothing_is_removed_from_a_folder_without_a_finished_result(tmp_path):
    before = folder_of_the_user(tmp_path)
    folder = OutputFolder(tmp_path)
    folder.remove_result()
    assert set(tmp_path.rglob("*")) == before
    with pytest.raises(InputError) as caught:
        folder.refuse_finished()
    assert caught.value.code == "output_not_empty"


def test_a_finished_result_goes_whole_and_the_users_files_beside_it_stay(tmp_path):
    folder_of_the_user(tmp_path)
    (tmp_path / REPORT).write_text("{}")
    (tmp_path / "thesis.tex").write_text("mine")
    OutputFolder(tmp_path).remove_result()
    assert {path.name for path in tmp_path.iterdir()} == {"thesis.tex"}
