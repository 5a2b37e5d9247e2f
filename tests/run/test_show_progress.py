"""The bar and the lines that people see of a run."""

from __future__ import annotations

import io
import logging
import re
import sys

import pytest

from biresnerf.forecast.run_forecast import RATES, Forecast
from biresnerf.progress import Monitor, Progress
from biresnerf.run import show_progress
from biresnerf.run.show_progress import ShownProgress, in_words


class Terminal(io.StringIO):
    """What a terminal was sent."""

    def isatty(self) -> bool:
        return True


def run_of(steps: int) -> list[Progress]:
    told = [Progress(stage="preparing", message="resuming at step 3")]
    for step in range(1, steps + 1):
        told.append(
            Progress(
                stage="coarse", step=step, steps_total=steps, fraction=step / steps, eta_s=75.0 * (1 - step / steps),
                metrics={"psnr": 12.5},
            )
        )  # fmt: skip
    return told


def shown(monkeypatch: pytest.MonkeyPatch, stream: io.StringIO, steps: int) -> str:
    monkeypatch.setattr(sys, "stderr", stream)
    monkeypatch.setenv("COLUMNS", "97")  # at 40 % the bar then ends with a whole block
    monkeypatch.setenv("LINES", "30")  # without it tqdm does not ask for the columns
    monkeypatch.delitem(sys.modules, "ipykernel", raising=False)  # where a notebook's tests ran before
    with ShownProgress() as show:
        for progress in run_of(steps):
            show(progress)
            if progress.step == 2:
                logging.getLogger("tests").warning("a word of the log")
    return stream.getvalue()


def test_a_terminal_has_one_bar_with_the_time_left_and_news_above_it(monkeypatch):
    monkeypatch.setattr(logging.getLogger(), "handlers", [logging.StreamHandler(terminal := Terminal())])
    said = shown(monkeypatch, terminal, 5)
    drawn = said.split("\r")
    assert "resuming at step 3\n" in said
    assert re.search(r"coarse  40 %\|[#█]+ +\| 00:0\d, step 2/5  train PSNR 12\.5 dB  0:45 left", said)
    assert any(part.strip() == "a word of the log" for part in re.split(r"[\r\n]", said))
    assert drawn[-1].strip() == "", "the bar leaves nothing behind"


def test_a_file_has_lines_without_control_characters(monkeypatch):
    monkeypatch.setattr(show_progress, "LINE_EVERY_S", 3600.0)
    said = shown(monkeypatch, io.StringIO(), 40)
    lines = said.splitlines()
    assert lines[0] == "preparing    0 % resuming at step 3"
    assert lines[1].startswith("coarse ")
    assert "\r" not in said
    assert len(lines) == 2  # of 41 reports within the hour


def test_a_file_has_a_line_every_few_seconds(monkeypatch):
    monkeypatch.setattr(show_progress, "LINE_EVERY_S", 0.0)
    assert len(shown(monkeypatch, io.StringIO(), 40).splitlines()) == 41


@pytest.mark.parametrize(
    ("share", "words"), [(0.5, "1:01 left (the machine is busy now)"), (0.9, "1:01 left")]
)
def test_the_time_left_says_that_the_machine_is_busy(share: float, words: str):
    told: list[Progress] = []
    monitor = Monitor(told.append, forecast=Forecast(RATES, lambda _began, _ended: share))
    monitor.forecast.left = {"evaluating": 61 / RATES["evaluation"]}
    monitor.report(Progress(stage="evaluating", metrics={"loss": 0.5}))
    assert in_words(told[0]) == f"loss 0.50000  {words}"
