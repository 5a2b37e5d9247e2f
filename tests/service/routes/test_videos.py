"""A video is a dataset as photos are: it may be as large as videos are, and is checked by its frames."""

from __future__ import annotations

from pathlib import Path

import httpx
import numpy as np

from tests.data.photos.video.filmed import film
from tests.service.conftest import new_dataset, problem, upload, zip_of
from workers.settings.settings import Settings


def test_a_video_that_is_sent_is_ready_with_its_frames(http: httpx.Client, tmp_path: Path) -> None:
    film(tmp_path / "walk.mov", np.linspace(0, 200, 40), [False] * 40)
    dataset = new_dataset(http)
    sent = http.put(f"/v1/datasets/{dataset}/files/walk.mov", content=(tmp_path / "walk.mov").read_bytes())
    assert sent.status_code == 201, sent.text
    found = http.post(f"/v1/datasets/{dataset}/finalize").json()
    assert found["state"] == "ready"
    assert (found["files"], found["report"]["images"], found["report"]["format"]) == (1, 40, "images")
    assert any("walk.mov" in line for line in found["report"]["warnings"])


def test_a_file_that_is_no_video_is_refused_by_its_name(http: httpx.Client) -> None:
    dataset = new_dataset(http)
    assert upload(http, dataset, zip_of({"walk.mp4": b"\0\0\0\x18ftypmp42" + bytes(99)})).is_success
    answer = problem(http.post(f"/v1/datasets/{dataset}/finalize"), 422, "video_unreadable")
    assert "walk.mp4" in answer["where"]


def test_a_file_may_be_as_large_as_a_video_of_some_minutes() -> None:
    assert Settings().max_file_bytes >= 10 * 60 * 50e6 / 8 / 2  # half of ten minutes at 50 Mbit/s
