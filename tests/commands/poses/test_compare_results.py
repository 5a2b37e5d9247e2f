"""`biresnerf compare-results` on a real result, and on a variant of it that kept the input's poses."""

from __future__ import annotations

import json
import shutil
from pathlib import Path

import pytest
from click.testing import CliRunner

from biresnerf.commands.poses.compare_results import compare_results_command
from biresnerf.comparison.conclusion import Comparison
from biresnerf.errors import InputError

EXAMPLE = Path(__file__).parents[3] / "service/example"  # ten degrees off at first, and refined


@pytest.fixture
def kept(tmp_path: Path) -> Path:
    """The example with the poses that were given."""
    folder = tmp_path / "kept"
    folder.mkdir()
    poses = json.loads((EXAMPLE / "poses.json").read_text())
    for image in poses["images"]:
        image["world_from_cam"] = image["world_from_cam_before"]
    (folder / "poses.json").write_text(json.dumps(poses))
    report = json.loads((EXAMPLE / "report.json").read_text())
    report["verdict"].update(verdict="kept_input", returned="input")
    (folder / "report.json").write_text(json.dumps(report))
    return folder


def said(*arguments: object) -> str:
    result = CliRunner().invoke(
        compare_results_command, [str(each) for each in arguments], catch_exceptions=False
    )
    assert result.exit_code == 0
    return result.output


def test_the_refined_poses_win_against_those_that_were_given(kept: Path) -> None:
    text = said(EXAMPLE, kept)
    conclusion, *grounds = text.splitlines()
    assert conclusion.startswith("The results contradict each other")
    assert (
        "The evidence favours the first: it is better by fit of feature matches and unseen views"
        in conclusion
    )
    seen = json.loads((EXAMPLE / "report.json").read_text())["verdict"]["heldout"]["psnr"]
    both = f"{seen['after']:.2f} dB and {seen['before']:.2f} dB"
    assert any(f"Unseen views: {both}; the first is better" in line for line in grounds)
    assert f"{seen['after']:.2f} dB (better)" in text
    assert "The evidence favours the second" in said(kept, EXAMPLE).splitlines()[0]


def test_json_holds_the_same_conclusion(kept: Path) -> None:
    answer = Comparison.model_validate_json(said(EXAMPLE, kept, "--json"))
    assert (answer.outcome, answer.contradict, answer.photos) == ("first", True, 32)
    assert said(EXAMPLE, kept).startswith(answer.conclusion)
    turns = [pose.turned_deg for pose in answer.poses]
    assert turns == sorted(turns, reverse=True)


def test_a_result_and_itself_are_the_same(tmp_path: Path) -> None:
    assert said(EXAMPLE, EXAMPLE) == "Both results hold the same poses.\n"
    shutil.copy(EXAMPLE / "report.json", tmp_path)
    with pytest.raises(InputError) as caught:
        said(EXAMPLE, tmp_path)
    assert "poses.json" in str(caught.value)
    with pytest.raises(InputError) as caught:
        said(tmp_path / "nowhere", EXAMPLE)
    assert caught.value.code == "result_missing"
