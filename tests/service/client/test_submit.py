"""`biresnerf submit` as users run it, against the running service."""

from __future__ import annotations

import json
import os
import pty
import re
import select
import shutil
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Iterator
from datetime import datetime, timedelta
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path

import httpx
import pytest

from biresnerf.client import Client, ServiceError
from biresnerf.wire.results import ArtifactView
from tests.service.conftest import Running, dataset_ids, finished
from tests.service.free_port import free_port

pytestmark = pytest.mark.server

COMMAND = (sys.executable, "-m", "biresnerf.command_line", "submit")
FAST = ("--preset", "fast", "--set", "steps=40", "--set", "seed=50")


def submit(service: Running, *arguments: str | Path) -> subprocess.CompletedProcess[str]:
    environment = {**os.environ, "BIRESNERF_URL": service.url}
    return subprocess.run(
        [*COMMAND, *map(str, arguments)], env=environment, capture_output=True, text=True, timeout=90
    )


def test_a_scene_goes_there_and_the_results_come_back(
    http: httpx.Client, service: Running, scene: Path, tmp_path: Path
) -> None:
    output = tmp_path / "out"
    done = submit(service, scene, *FAST, "--wait", "--output", output)
    assert done.returncode == 0, done.stderr
    url = done.stdout.splitlines()[0]
    assert url.startswith(f"{service.url}/#/jobs/")
    job = http.get(f"/v1/jobs/{url.rpartition('/')[2]}").json()
    assert job["state"] == "succeeded"
    assert json.loads((output / "transforms.json").read_text()) == json.loads(
        (scene / "transforms.json").read_text()
    )
    items = http.get(job["links"]["artifacts"]).json()["items"]
    assert {path.relative_to(output).as_posix() for path in output.rglob("*") if path.is_file()} == {
        item["name"] for item in items
    }
    # In a pipe: plain lines, with stage, step, loss and time left.
    assert re.search(r"(coarse|fine) +\d+ %  step \d+/40  loss 0\.\d+  left \d:\d\d", done.stderr)
    assert "\x1b" not in done.stderr


def test_on_a_terminal_there_is_a_bar(service: Running, scene: Path) -> None:
    leader, follower = pty.openpty()
    environment = {
        **os.environ,
        "BIRESNERF_URL": service.url,
        "TERM": "xterm",
        "COLUMNS": "120",
        "NO_COLOR": "",
    }
    process = subprocess.Popen(
        [*COMMAND, scene, *FAST, "--wait"], env=environment, stdout=follower, stderr=follower, stdin=follower
    )
    os.close(follower)
    shown = b""
    while process.poll() is None or select.select([leader], [], [], 0.1)[0]:
        try:
            shown += os.read(leader, 65536) if select.select([leader], [], [], 0.1)[0] else b""
        except OSError:
            break
    os.close(leader)
    assert process.wait() == 0, shown
    text = re.sub(r"\x1b\[[0-9;?]*[A-Za-z]", "", shown.decode())
    assert "━" in text
    assert re.search(r"fine .*100%|100%", text)
    assert re.search(r"step \d+/40 +loss", text)


def test_without_wait_only_the_address_is_printed(http: httpx.Client, service: Running, scene: Path) -> None:
    done = submit(service, scene / "transforms.json", *FAST)
    assert done.returncode == 0, done.stderr
    assert re.fullmatch(rf"{service.url}/#/jobs/job_\w+\n", done.stdout)
    assert finished(http, done.stdout.strip().rsplit("/", 1)[1])["state"] == "succeeded"


@pytest.mark.parametrize(
    ("arguments", "said"),
    [
        (("--set", "stepz=5"), "stepz: unknown option"),
        (("--set", "steps"), "is not key=value"),
        (("--preset", "best"), "preset"),
        (("--output", "."), "is not an empty folder"),
    ],
)
def test_what_the_user_can_fix_is_exit_2(
    service: Running, scene: Path, arguments: tuple[str, ...], said: str
) -> None:
    done = submit(service, scene, *arguments)
    assert (done.returncode, done.stdout) == (2, "")
    assert said in done.stderr
    assert "Traceback" not in done.stderr


def test_a_job_is_sent_with_its_limits_of_time(http: httpx.Client, service: Running, scene: Path) -> None:
    local = (datetime.now() + timedelta(days=2)).isoformat(timespec="minutes")
    done = submit(service, scene, *FAST, "--deadline", local, "--expires-in-queue", "86400", "--json")
    assert done.returncode == 0, done.stderr
    job = json.loads(done.stdout)
    assert datetime.fromisoformat(job["deadline_at"]) == datetime.fromisoformat(local).astimezone()
    waits = datetime.fromisoformat(job["start_by"]) - datetime.fromisoformat(job["created_at"])
    assert abs(waits.total_seconds() - 86_400) < 1
    finished(http, job["id"])
    for wrong in (
        ("--deadline", "tomorrow"),
        ("--deadline", "2026-01-31T18:30"),
        ("--expires-in-queue", "0"),
    ):
        refused = submit(service, scene, *FAST, *wrong)
        assert refused.returncode == 2, refused.stderr
        assert wrong[0] in refused.stderr or "deadline_refused" in refused.stderr


def test_a_job_that_splits_itself_says_how_many_parts_are_over(service: Running, scene: Path) -> None:
    done = submit(service, scene, *FAST, "--part-photos", "20", "--wait")
    assert done.returncode == 0, done.stderr
    lines = done.stderr.splitlines()
    assert "Any workers refine the set in 3 parts; then the job joins them." in lines
    assert [f"{n} of 3 parts are over." in lines for n in (1, 2, 3)] == [True] * 3


def test_a_bad_scene_is_exit_2_and_leaves_no_dataset(
    http: httpx.Client, service: Running, scene: Path, tmp_path: Path
) -> None:
    copy = tmp_path / "copy"
    shutil.copytree(scene, copy)
    whole = (copy / "train" / "r_2.png").read_bytes()
    (copy / "train" / "r_2.png").write_bytes(whole[: len(whole) // 2])
    before = dataset_ids(http)
    done = submit(service, copy, "--wait")
    assert done.returncode == 2, done.stderr
    assert "r_2" in done.stderr
    assert dataset_ids(http) == before


def test_a_failed_job_is_exit_3_and_a_missing_service_exit_6(service: Running, scene: Path) -> None:
    done = submit(service, scene, "--set", "threads=77", "--wait")
    assert done.returncode == 3
    assert "diverged" in done.stderr
    done = submit(service, scene, "--url", f"http://127.0.0.1:{free_port()}")
    assert done.returncode == 6
    assert "biresnerf up" in done.stderr
    assert len(done.stderr.splitlines()) == 1


def test_ctrl_c_ends_the_waiting_and_not_the_job(http: httpx.Client, service: Running, scene: Path) -> None:
    environment = {**os.environ, "BIRESNERF_URL": service.url}
    process = subprocess.Popen(
        [*COMMAND, scene, "--set", "steps=60", "--set", "seed=50", "--wait"],
        env=environment,
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
    )
    assert process.stdout is not None
    url = process.stdout.readline().strip()
    time.sleep(0.5)
    process.send_signal(signal.SIGINT)
    _, said = process.communicate(timeout=20)
    assert process.returncode == 130
    assert "Traceback" not in said
    assert f"biresnerf wait '{url}'" in said
    assert finished(http, url.rsplit("/", 1)[1])["state"] == "succeeded"


def copies(scene: Path, folder: Path, *names: str) -> list[Path]:
    for name in names:
        shutil.copytree(scene, folder / name)
    return [folder / name for name in names]


def test_several_sets_become_one_batch_with_a_line_and_a_folder_for_each(
    http: httpx.Client, service: Running, scene: Path, tmp_path: Path
) -> None:
    hall, kitchen, alike = copies(scene, tmp_path, "hall", "kitchen", "other/hall")
    output = tmp_path / "out"
    done = submit(service, hall, kitchen / "transforms.json", alike, *FAST, "--label", "day=1", "-o", output)
    assert done.returncode == 0, done.stderr
    lines = [line.split("  ") for line in done.stdout.splitlines()]
    assert [path for _, path in lines] == [str(hall), str(kitchen / "transforms.json"), str(alike)]
    jobs = [http.get(f"/v1/jobs/{url.removeprefix(f'{service.url}/#/jobs/')}").json() for url, _ in lines]
    assert [job["labels"] for job in jobs] == [
        {"name": name, "day": "1"} for name in ("hall", "kitchen", "hall-2")
    ]
    assert [job["state"] for job in jobs] == ["succeeded"] * 3
    (batch,) = {job["batch_id"] for job in jobs}
    assert [job["id"] for job in http.get(f"/v1/batches/{batch}").json()["jobs"]] == [
        job["id"] for job in jobs
    ]
    for name in ("hall", "kitchen", "hall-2"):
        assert (output / name / "report.json").is_file()
        assert re.search(rf"^{name}: succeeded", done.stderr, re.MULTILINE)


def test_of_several_sets_a_bad_one_is_named_and_the_others_are_queued(
    http: httpx.Client, service: Running, scene: Path, tmp_path: Path
) -> None:
    good, bad, better = copies(scene, tmp_path, "good", "bad", "better")
    whole = (bad / "train" / "r_2.png").read_bytes()
    (bad / "train" / "r_2.png").write_bytes(whole[: len(whole) // 2])
    done = submit(service, good, bad, tmp_path / "nowhere", better, *FAST, "--json")
    assert done.returncode == 2, done.stderr
    assert [job["labels"]["name"] for job in json.loads(done.stdout)["jobs"]] == ["good", "better"]
    for job in json.loads(done.stdout)["jobs"]:
        assert finished(http, job["id"])["state"] == "succeeded"
    assert re.search(rf"^{re.escape(str(bad))}: .*r_2", done.stderr, re.MULTILINE)
    assert f"{tmp_path / 'nowhere'}: " in done.stderr
    assert done.stderr.splitlines()[-1] == "error: 2 of 4 sets cannot be used."
    names = [item["name"] for item in http.get("/v1/datasets").json()["items"]]
    assert "bad" not in names, "its dataset is deleted"


def test_of_several_jobs_one_that_fails_decides_the_exit_status(
    service: Running, scene: Path, tmp_path: Path
) -> None:
    done = submit(service, *copies(scene, tmp_path, "a", "b"), "--set", "threads=77", "--wait")
    assert done.returncode == 3, done.stderr
    assert re.search(r"^a: failed, .*diverged", done.stderr, re.MULTILINE)
    assert done.stderr.splitlines()[-1] == "error: 2 of 2 jobs did not succeed."
    for alone in (("--resume", "ds_1"), ("--fixed-from", "job_1"), ("--deliver", "s3://bucket/one.zip")):
        refused = submit(service, tmp_path / "a", tmp_path / "b", *alone)
        assert (refused.returncode, refused.stdout) == (2, "")
        assert alone[0] in refused.stderr


CONTENT = os.urandom(300_000)


class Flaky(BaseHTTPRequestHandler):
    """Breaks off the first download in its middle; damages another file."""

    tries: list[str | None]

    def do_GET(self) -> None:
        wanted = self.headers.get("Range")
        self.tries.append(wanted)
        start = int(wanted.removeprefix("bytes=").removesuffix("-")) if wanted else 0
        self.send_response(206 if wanted else 200)
        self.send_header("Content-Length", str(len(CONTENT) - start))
        self.end_headers()
        content = bytes(len(CONTENT)) if self.path == "/damaged" else CONTENT
        self.wfile.write(content[start : start + 100_000] if len(self.tries) == 1 else content[start:])

    def log_message(self, *_: object) -> None:
        """Quiet."""


@pytest.fixture
def flaky() -> Iterator[str]:
    Flaky.tries = []
    server = ThreadingHTTPServer(("127.0.0.1", 0), Flaky)
    threading.Thread(target=server.serve_forever, daemon=True).start()
    yield f"http://127.0.0.1:{server.server_port}"
    server.shutdown()
    server.server_close()


def artifact(path: str) -> ArtifactView:
    import hashlib

    digest = hashlib.sha256(CONTENT).hexdigest()
    return ArtifactView(name="a", size=len(CONTENT), sha256=digest, media_type="x/y", href=path)


def test_a_broken_download_goes_on_where_it_broke_off(flaky: str, tmp_path: Path) -> None:
    with Client(flaky) as client:
        client.download(artifact("/whole"), tmp_path / "a")
    assert (tmp_path / "a").read_bytes() == CONTENT
    assert Flaky.tries[0] is None
    assert Flaky.tries[1] is not None
    assert [path.name for path in tmp_path.iterdir()] == ["a"]


def test_a_damaged_download_leaves_no_file(flaky: str, tmp_path: Path) -> None:
    with Client(flaky) as client, pytest.raises(ServiceError, match="damaged"):
        client.download(artifact("/damaged"), tmp_path / "a")
    assert list(tmp_path.iterdir()) == []
