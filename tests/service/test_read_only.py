"""A disk that became read-only: uploads are refused, existing files can be downloaded, and jobs wait."""

from __future__ import annotations

import contextlib
import os
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import httpx
import pytest

from tests.service.conftest import (
    PROGRAM,
    finished,
    new_dataset,
    problem,
    ready_dataset,
    running_service,
    scene_files,
    short_folder,
    submit,
    until,
    zip_of,
)

pytestmark = [
    pytest.mark.server,
    pytest.mark.skipif(os.geteuid() != 0, reason="only root can make a disk read-only"),
]
TUS = {"Tus-Resumable": "1.0.0", "Upload-Length": "5"}


@contextlib.contextmanager
def read_only(folder: Path) -> Iterator[None]:
    """The folder as if its disk had failed: nobody can write to it, not even root, whom permissions do not stop."""
    subprocess.run(["mount", "--bind", folder, folder], check=True)
    try:
        subprocess.run(["mount", "-o", "remount,ro,bind", folder], check=True)
        yield
    finally:
        subprocess.run(["umount", "--lazy", folder], check=True)


@pytest.mark.parametrize("which", ["files", "staging", "scratch"])
def test_nothing_is_lost_while_a_disk_can_only_be_read(scene: Path, which: str) -> None:
    with (
        short_folder() as folder,
        running_service(folder, job_command=(sys.executable, str(PROGRAM))) as service,
        httpx.Client(base_url=service.url, timeout=60.0) as http,
    ):
        dataset, empty = ready_dataset(http, scene), new_dataset(http)
        done = finished(http, submit(http, dataset)["id"])
        begun = http.post(f"/v1/datasets/{empty}/uploads", headers=TUS).headers["location"]
        offset = {**TUS, "Upload-Offset": "0", "Content-Type": "application/offset+octet-stream"}
        archive = zip_of(scene_files(scene))
        ways_in = {
            "files": (
                lambda: http.put(f"/v1/datasets/{empty}/files/a", content=b"x"),
                lambda: http.patch(begun, headers=offset, content=b"12345"),
            ),
            "staging": (
                lambda: http.post(f"/v1/datasets/{empty}/archive", content=archive),
                lambda: http.post("/v1/jobs", files={"archive": archive}),
            ),
            "scratch": (),
        }
        asked = [*ways_in[which], *(ways_in["staging"] if which == "files" else ())]
        with read_only(service.data_dir / which):
            for ask in asked:
                answer = ask()
                codes = (503, "storage_unavailable") if which == "files" else (507, "storage_full")
                assert problem(answer, *codes)["retryable"]
                assert str(folder) not in answer.text
            assert http.get("/livez").status_code == 200
            assert http.get("/readyz").status_code == (503 if which == "files" else 200)
            assert http.get(f"/v1/jobs/{done['id']}/artifacts/report.json").status_code == 200
            job = submit(http, dataset, steps=21)
            if which == "scratch":
                until(
                    http,
                    job["id"],
                    lambda now: now["message"] == "Waiting: the worker's disk is full or read-only.",
                )
            elif which == "files":
                until(http, job["id"], lambda now: now["stage"] == "exporting")
        assert finished(http, job["id"])["state"] == "succeeded"
        for ask in asked:
            assert ask().status_code < 300
        assert http.get("/readyz").status_code == 200
