"""What a second try with less memory asks of COLMAP."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import pytest

from biresnerf.data.formats.read_dataset import read_dataset
from biresnerf.data.seeding import map_images
from biresnerf.data.seeding.cached_mapping import remembered_mapping
from biresnerf.data.synthetic.scene import write_synthetic_scene
from biresnerf.errors import Interrupted
from biresnerf.options.refine_options import RefineOptions, parse_options
from biresnerf.pipeline import refine_poses
from workers.run.attempt import smaller_options

pytestmark = pytest.mark.slow


@pytest.fixture
def photos(tmp_path: Path) -> Path:
    """A set of which nobody has said anything."""
    write_synthetic_scene(tmp_path / "photos", n_views=6, size=32, seed=1)
    (tmp_path / "photos" / "transforms.json").unlink()
    return tmp_path / "photos"


@pytest.fixture
def asked(monkeypatch: pytest.MonkeyPatch) -> list[dict[str, Any]]:
    """What COLMAP's process is asked; it is not begun."""
    requests: list[dict[str, Any]] = []

    def keep(request: dict[str, Any], *_: Any) -> dict[str, Any]:
        requests.append(json.loads(json.dumps(request)))
        raise Interrupted("seen enough")

    monkeypatch.setattr(map_images, "run_colmap", keep)
    return requests


def test_a_second_try_reaches_colmap(photos: Path, asked: list[dict[str, Any]], tmp_path: Path):
    first = RefineOptions(preset="fast").model_dump(exclude_unset=True)
    smaller = smaller_options(RefineOptions(preset="fast").resolved("cpu"))
    for name, options in (("first", first), ("second", {**first, **smaller})):
        with pytest.raises(Interrupted):
            refine_poses(photos, tmp_path / name, parse_options(options))
    before, after = asked
    assert (before["threads"], after["threads"]) == (-1, 1)
    assert (before["thorough"], after["thorough"]) == (True, False)
    assert after["widest_image"] <= before["widest_image"] / 2
    assert after["most_features"] <= before["most_features"] / 4
    same = {
        "threads",
        "mapping_threads",
        "thorough",
        "widest_image",
        "most_features",
        "error_scale",
        "root",
        "work",
        "answer",
        "kept",
    }
    assert {k: v for k, v in before.items() if k not in same} == {
        k: v for k, v in after.items() if k not in same
    }


def test_an_answer_found_with_more_effort_is_not_asked_for_again_and_one_with_less_is(
    photos: Path, asked: list[dict[str, Any]], tmp_path: Path
):
    dataset, kept = read_dataset(photos), tmp_path / "kept.json"

    def ask(effort: Any) -> bool:
        """Whether COLMAP was asked."""
        before = len(asked)
        try:
            remembered_mapping(dataset, lambda: False, 0, effort, kept, lambda _: None)
        except Interrupted:
            return len(asked) > before
        return False

    def keep_as(effort: Any, monkeypatch: pytest.MonkeyPatch) -> None:
        with monkeypatch.context() as patched:
            answer = {"models": [], "matches": []}
            patched.setattr(map_images, "run_colmap", lambda *_: answer)
            patched.setattr(map_images, "keep_tracks", lambda *_: None)
            kept.unlink(missing_ok=True)
            remembered_mapping(dataset, lambda: False, 0, effort, kept, lambda _: None)

    with pytest.MonkeyPatch.context() as monkeypatch:
        keep_as("full", monkeypatch)
        assert [ask("full"), ask("low")] == [False, False]
        keep_as("low", monkeypatch)
        assert [ask("low"), ask("full")] == [False, True]
