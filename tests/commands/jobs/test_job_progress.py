"""Progress output without a terminal, and its content."""

from __future__ import annotations

from typing import Any

import pytest

from biresnerf.client import Sending
from biresnerf.commands.jobs import job_progress
from biresnerf.commands.jobs.job_progress import (
    BytesView,
    JobProgressView,
    SendingView,
    left_of,
    numbers_of,
    stage_of,
)
from biresnerf.wire.jobs import JobProgress, JobView


def job(state: str = "running", **values: Any) -> JobView:
    progress = JobProgress.model_construct(
        **{"fraction": 0.25, "step": 5, "steps_total": 20, "eta_s": 83.4, **values.pop("progress", {})}
    )
    given = {
        "id": "job_1",
        "dataset_id": "ds_1",
        "state": state,
        "stage": None,
        "queue_position": None,
        "metrics": {},
        "progress": progress,
    }
    return JobView.model_construct(**{**given, **values})


@pytest.mark.parametrize(
    ("seen", "stage"),
    [
        (job("queued", queue_position=3), "waiting 3"),
        (job("queued"), "waiting"),
        (job("running"), "running"),
        (job("running", stage="coarse"), "coarse"),
        (job("failed", stage="coarse"), "failed"),
    ],
)
def test_a_jobs_stage_is_its_place_its_stage_or_its_end(seen: JobView, stage: str) -> None:
    assert stage_of(seen) == stage


def test_numbers_are_those_that_are_known() -> None:
    assert numbers_of(job(metrics={"loss": 0.0123456, "psnr": 21.5, "other": 1.0})) == (
        "step 5/20  loss 0.01235  psnr 21.5"
    )
    assert numbers_of(job(progress={"steps_total": 0})) == ""
    assert (left_of(job()), left_of(job(progress={"eta_s": None}))) == ("1:23", "?")


def test_without_a_terminal_a_line_comes_at_each_stage_and_not_at_each_step(
    capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    with JobProgressView() as view:
        for stage in ("coarse", "coarse", "fine"):
            view.job(job(stage=stage))
        monkeypatch.setattr(job_progress, "_LINE_EVERY_S", 0.0)
        view.job(job(stage="fine"))
    lines = capsys.readouterr().err.splitlines()
    assert [line.split()[0] for line in lines] == ["coarse", "fine", "fine"]
    assert lines[0] == "coarse      25 %  step 5/20  left 1:23"


def test_bytes_add_up(capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch) -> None:
    with BytesView("downloading") as view:
        view.more(1_500_000, 4_000_000)
        assert capsys.readouterr().err == ""  # it has only just begun
        monkeypatch.setattr(job_progress, "_LINE_EVERY_S", 0.0)
        view.more(1_000_000, 4_000_000)
    assert capsys.readouterr().err == "downloading 2.5 of 4.0 MB\n"


def test_a_submission_says_what_is_sent_and_what_is_there(capsys: pytest.CaptureFixture[str]) -> None:
    with SendingView() as view:
        view.sending(Sending("reading"))
        for sent in (0, 500_000):
            view.sending(Sending("sending", 5, 2, 1_000_000, sent, "ds_1"))
        view.sending(Sending("checking", 5, 2, 1_000_000, 1_000_000, "ds_1"))
    assert capsys.readouterr().err.splitlines() == [
        "sending 2 of 5 files, 1.0 MB; the service has 3 already",
        "checking the files",
    ]
