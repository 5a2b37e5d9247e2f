"""The page of a run that was stopped: where, and what that means for poses and verdict."""

from __future__ import annotations

import json
import shutil
from pathlib import Path

import pytest
from playwright.sync_api import Browser, expect

from biresnerf.errors import Interrupted
from biresnerf.pipeline import refine_poses
from biresnerf.viewer.report_html import read_report, write_report_html
from tests.viewer.conftest import OPTIONS, VIEWS, Opened, Result, open_report

STOPPED_AT = 60


@pytest.fixture(scope="module")
def stopped_run(result: Result, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The folder of a run of 200 steps that was stopped on the way."""
    folder = tmp_path_factory.mktemp("stopped") / "out"
    history = folder / "history.jsonl"

    def enough() -> bool:
        lines = history.read_text().splitlines() if history.is_file() else []
        return bool(lines) and json.loads(lines[-1])["step"] >= STOPPED_AT

    with pytest.raises(Interrupted):
        refine_poses(result.scene, folder, OPTIONS, should_stop=enough)
    return folder


def test_a_stopped_runs_page_says_at_which_step_and_that_nothing_is_final(
    browser: Browser, stopped_run: Path
) -> None:
    report = read_report(stopped_run)
    assert STOPPED_AT <= report.steps_done < OPTIONS.steps
    assert report.verdict_so_far is not None
    page = open_report(browser, stopped_run / "report.html").page
    at = f"{report.steps_done} of {OPTIONS.steps}"
    expect(page.get_by_role("heading", level=1)).to_have_text(f"Poses so far of {VIEWS} images")
    expect(page.locator(".report-head")).to_contain_text(f"stopped after {at} steps")
    verdict = page.get_by_role("region", name="Verdict")
    expect(verdict).to_contain_text(f"The run was stopped at step {at}.")
    expect(verdict).to_contain_text(
        "There is no verdict: the test on photos that were held back comes at the end"
    )
    returned = {"input": "no better ones were found until then", "refined": "which are not final"}
    expect(verdict).to_contain_text(returned[report.verdict_so_far.returned])
    expect(verdict).to_contain_text(report.verdict_so_far.why[0])
    expect(page.get_by_text("Views are rendered at the end of a run.")).to_be_visible()
    expect(page.locator(".curves-stages")).to_contain_text("the run was stopped before stage 2")
    page.context.close()


def test_names_of_photos_can_be_hit_also_where_no_small_photos_are_there_yet(
    browser: Browser, result: Result, tmp_path: Path
) -> None:
    folder = shutil.copytree(result.folder, tmp_path / "out")
    (folder / "view.json").unlink()
    assert write_report_html(folder, result.report) == ()
    page = open_report(browser, folder / "report.html").page
    expect(page.locator(".images .thumb")).to_have_count(0)
    boxes = [name.bounding_box() for name in page.locator(".images tbody button").all()]
    assert len(boxes) == VIEWS
    assert min(box["height"] for box in boxes if box) >= 24  # px, of WCAG 2.5.8
    page.context.close()


def test_the_chart_of_stage_1_says_what_it_measures_and_what_it_decides(
    opened: Opened, result: Result
) -> None:
    page = opened.page
    lines = [json.loads(line) for line in (result.folder / "history.jsonl").read_text().splitlines()]
    gains = [line for line in lines if line["stage"] == "coarse" and line.get("trend_db") is not None]
    chart = page.locator("figure.curve").filter(has_text="What stage 1 still gains")
    expect(chart).to_contain_text("How much better the photos fit than halfway through the steps so far.")
    expect(chart).to_contain_text("Stage 2 begins once this stays between the dashed lines")
    # The better photos fit, the higher the line: its last value is the last gain.
    said = chart.get_by_role("img").get_attribute("aria-label") or ""
    assert f"{gains[-1]['trend_db']:.2f} dB at step {gains[-1]['step']}." in said
    expect(page.get_by_text("Stability signal")).to_have_count(0)
