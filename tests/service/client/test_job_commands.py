"""The commands about jobs, as a shell runs them, against the running service."""

from __future__ import annotations

import json
import os
import pty
import re
import signal
import subprocess
import sys
import threading
import time
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path
from typing import Any
from urllib.parse import urlsplit

import httpx
import pytest
from click.testing import CliRunner, Result

from biresnerf.client import Client, ServiceError
from biresnerf.commands import exit_codes
from biresnerf.commands.jobs.download import download_command
from biresnerf.commands.jobs.follow_job import waited_for
from biresnerf.commands.jobs.fork import fork_command
from biresnerf.commands.jobs.jobs import (
    cancel_command,
    delete_command,
    list_command,
    logs_command,
    status_command,
    wait_command,
)
from biresnerf.commands.jobs.service_options import exit_code_of
from biresnerf.commands.jobs.submit import submit_command
from tests.service.client.relay import Relay
from tests.service.conftest import Running, Tenant, finished, submit, until
from tests.service.free_port import free_port

pytestmark = pytest.mark.server

COMMANDS = {
    "submit": submit_command,
    "status": status_command,
    "list": list_command,
    "wait": wait_command,
    "logs": logs_command,
    "cancel": cancel_command,
    "delete": delete_command,
    "download": download_command,
    "fork": fork_command,
}
PROGRAM = (sys.executable, "-m", "biresnerf.command_line")


def run(service: Running, name: str, *arguments: object, **variables: str | None) -> Result:
    """In this process; errors that `main` turns into a status do so here, too."""
    environment = {"BIRESNERF_URL": service.url, "BIRESNERF_API_KEY": None, **variables}
    return CliRunner().invoke(COMMANDS[name], [str(a) for a in arguments], env=environment)


def document(result: Result) -> Any:
    assert result.exit_code == 0, result.output
    return json.loads(result.stdout)


def test_each_answer_is_one_json_document(service: Running, done_job: dict[str, Any], tmp_path: Path) -> None:
    job = done_job["id"]
    assert document(run(service, "status", job, "--json"))["state"] == "succeeded"
    assert document(run(service, "wait", job, "--json"))["id"] == job
    assert job in [
        item["id"] for item in document(run(service, "list", "--limit", 10_000, "--json"))["items"]
    ]
    assert [line["n"] for line in document(run(service, "logs", job, "--json"))["items"]] == [1, 2]
    got = document(run(service, "download", job, "report.json", "-o", tmp_path, "--json"))
    assert got["files"] == [str(tmp_path / "report.json")]
    assert document(run(service, "cancel", job, "--json"))["state"] == "succeeded"


def test_people_read_lines(service: Running, done_job: dict[str, Any], tmp_path: Path) -> None:
    job = done_job["id"]
    said = run(service, "status", f"{service.url}/v1/jobs/{job}", BIRESNERF_URL="http://127.0.0.1:9").stdout
    assert said.splitlines()[0] == f"{job}  succeeded"
    assert "verdict: kept_input" in said
    assert run(service, "logs", job).stdout == "images read\nline 2\n"
    assert run(service, "logs", job, "--after", 1, "--follow").stdout == "line 2\n"
    assert re.search(
        rf"(?m)^JOB.*\n(.*\n)*{job}  succeeded +100 %  \d+ \w+ ago +kept_input",
        run(service, "list", "--limit", 10_000).stdout,
    )
    assert run(service, "list", "--label", "no=such").stdout == "no jobs\n"
    assert "files in" in run(service, "download", job, "-o", tmp_path / "out").stdout
    assert (tmp_path / "out" / "colmap/sparse/0/images.bin").is_file()


def test_a_job_is_cancelled_with_what_it_has_and_then_deleted(
    service: Running, http: httpx.Client, done_job: dict[str, Any], tmp_path: Path
) -> None:
    job = submit(http, done_job["dataset_id"], steps=4000)["id"]
    until(http, job, lambda found: found["progress"]["step"] > 0)
    assert run(service, "delete", job).exit_code == exit_codes.INPUT  # not over yet
    said = run(service, "cancel", job, "--keep-partial", "--wait")
    assert said.exit_code == 0, said.output
    assert "partial result" in said.stdout
    got = run(service, "download", job, "-o", tmp_path / "partial")
    assert got.exit_code == 0
    assert (tmp_path / "partial" / "poses.json").is_file()
    assert run(service, "wait", job).exit_code == exit_codes.JOB
    assert document(run(service, "delete", job, "--json")) == {"deleted": [job]}
    assert run(service, "status", job).exit_code == exit_codes.NOT_FOUND


def test_what_goes_wrong_is_one_line_and_its_own_exit_status(
    service: Running,
    closed: Running,
    tenants: tuple[Tenant, Tenant],
    done_job: dict[str, Any],
    tmp_path: Path,
) -> None:
    job, nobody = done_job["id"], f"http://127.0.0.1:{free_port()}"
    unknown = "job_00000000000000000000000000"
    tries = [
        (("status", unknown), {}, exit_codes.NOT_FOUND, "No job"),
        (("download", unknown, "-o", tmp_path / "x"), {}, exit_codes.NOT_FOUND, "No job"),
        (("status", "../jobs"), {}, exit_codes.INPUT, "neither a job's id nor its address"),
        (("status", "a b"), {}, exit_codes.NOT_FOUND, ""),
        (("status", job), {"BIRESNERF_URL": nobody}, exit_codes.AWAY, "biresnerf up"),
        (("status", job), {"BIRESNERF_URL": "nonsense"}, exit_codes.INPUT, "not the address"),
        (("list",), {"BIRESNERF_URL": closed.url}, exit_codes.KEY, "API key"),
        (("list",), {"BIRESNERF_URL": closed.url, "BIRESNERF_API_KEY": "brn_x"}, exit_codes.KEY, "unknown"),
        (("fork", job, "--set", "warmup_steps=50"), {}, exit_codes.INPUT, "stage 1"),
        (("logs", job, "--follow", "--json"), {}, exit_codes.INPUT, "exclude each other"),
    ]
    for arguments, variables, status, said in tries:
        result = run(service, *arguments, **variables)  # type: ignore[arg-type]
        assert result.exit_code == status, (arguments, result.output, result.exception)
        assert result.stdout == ""
        assert said in result.stderr
        lines = [line for line in result.stderr.splitlines() if "rror" in line]
        assert len(lines) == 1, result.stderr
    assert run(service, "list", BIRESNERF_URL=closed.url, BIRESNERF_API_KEY=tenants[0].key).exit_code == 0


@pytest.mark.parametrize("status", [200, 404])
def test_another_program_at_the_address_is_said_to_be_none_of_ours(service: Running, status: int) -> None:
    class Stranger(BaseHTTPRequestHandler):
        def do_GET(self) -> None:
            self.send_response(status)
            self.end_headers()
            self.wfile.write(b"<!doctype html><title>Welcome</title>")

        def log_message(self, *_: object) -> None:
            """Quiet."""

    server = ThreadingHTTPServer(("127.0.0.1", 0), Stranger)
    threading.Thread(target=server.serve_forever, args=(0.01,), daemon=True).start()
    result = run(service, "status", "job_1", BIRESNERF_URL=f"http://127.0.0.1:{server.server_port}")
    server.shutdown()
    server.server_close()
    assert (result.exit_code, result.stdout) == (exit_codes.INPUT, "")
    assert "Check the address." in result.stderr
    assert len(result.stderr.splitlines()) == 1


def test_waiting_ends_when_its_time_is_up_with_a_status_of_its_own(
    service: Running, http: httpx.Client, scene: Path
) -> None:
    slow = ("--set", "steps=4000", "--set", "seed=5")  # 5 ms a step
    result = run(service, "submit", scene, *slow, "--timeout", 0.1, "--json")
    assert result.exit_code == exit_codes.NOT_OVER, result.output
    job = json.loads(result.stdout)
    result = run(service, "wait", job["id"], "--timeout", 0.1, "--json")
    assert result.exit_code == exit_codes.NOT_OVER, result.output
    assert json.loads(result.stdout)["state"] in {"queued", "running"}
    assert f"biresnerf wait '{service.url}/#/jobs/{job['id']}'" in result.stderr
    assert run(service, "wait", job["id"], "--timeout", 0).exit_code == exit_codes.INPUT
    http.post(job["links"]["cancel"])
    finished(http, job["id"])


def test_ctrl_c_while_sending_says_how_to_go_on(
    service: Running, http: httpx.Client, scene: Path, tmp_path: Path
) -> None:
    large = tmp_path / "large"
    (large / "images").mkdir(parents=True)
    import numpy as np
    from PIL import Image

    noise = np.random.default_rng(0).integers(0, 256, (700, 700, 3), np.uint8)
    for number in range(24):
        Image.fromarray(np.roll(noise, number, 0)).save(
            large / "images" / f"{number:02}.png", compress_level=0
        )
    process = subprocess.Popen(
        [*PROGRAM, "submit", str(large), "--url", service.url, "--set", "steps=20", "--set", "seed=1"],
        stderr=subprocess.PIPE,
        stdout=subprocess.PIPE,
        text=True,
    )
    assert process.stderr is not None
    line = process.stderr.readline()
    assert line.startswith("sending 24 of 24 files"), line
    process.send_signal(signal.SIGINT)
    out, said = process.communicate(timeout=60)
    if process.returncode == 0:
        pytest.skip("all was sent before the signal came")
    assert (process.returncode, out) == (exit_codes.SIGINT, "")
    assert "Traceback" not in said
    again = re.search(r"biresnerf (submit .* --resume (ds_\w+))", said)
    assert again is not None, said
    kept = http.get(f"/v1/datasets/{again[2]}").json()
    assert kept["state"] in {"open", "finalizing", "ready"}
    http.delete(f"/v1/datasets/{again[2]}")


def test_a_service_that_stays_away_while_a_job_is_waited_for_leaves_the_way_back(
    service: Running, http: httpx.Client, done_job: dict[str, Any], capsys: pytest.CaptureFixture[str]
) -> None:
    job = submit(http, done_job["dataset_id"], steps=4000, step_ms=20)["id"]
    port = urlsplit(service.url).port
    assert port is not None
    relay = Relay(port)
    with Client(f"http://127.0.0.1:{relay.port}", patience_s=0.1) as client:
        found = client.job(job)
        threading.Timer(0.2, relay.close).start()
        with pytest.raises(ServiceError) as caught:
            waited_for(client, found, None, as_json=False)
        assert (caught.value.code, exit_code_of(caught.value)) == ("unreachable", exit_codes.AWAY)
        assert f"biresnerf wait '{client.url}/#/jobs/{job}'" in capsys.readouterr().err
    http.post(found.links.cancel)
    finished(http, job)


def test_colour_is_left_out_where_it_is_not_wanted_and_bars_where_nobody_looks(
    service: Running, http: httpx.Client, done_job: dict[str, Any]
) -> None:
    seen = {}
    for wanted in ("", "1"):
        job = submit(http, done_job["dataset_id"], steps=30, step_ms=20)["id"]
        leader, follower = pty.openpty()
        environment = {**os.environ, "TERM": "xterm-256color", "COLUMNS": "100"}
        environment.pop("NO_COLOR", None)  # an empty one means the same to newer releases of rich alone
        environment |= {"NO_COLOR": wanted} if wanted else {}
        process = subprocess.Popen(
            [*PROGRAM, "wait", job, "--url", service.url], env=environment, stdout=follower, stderr=follower
        )
        os.close(follower)
        shown = b""
        while True:
            try:
                chunk = os.read(leader, 65536)
            except OSError:
                break
            if not chunk:
                break
            shown += chunk
        os.close(leader)
        assert process.wait() == 0
        seen[wanted] = shown.decode(errors="replace")
    coloured = re.compile(r"\x1b\[[0-9;]*(3[0-9]|9[0-9])m|\x1b\[[0-9;]*38;")
    assert coloured.search(seen[""])
    assert "━" in seen["1"]
    assert not coloured.search(seen["1"])


def test_ctrl_c_while_waiting_leaves_the_job_running(
    service: Running, http: httpx.Client, done_job: dict[str, Any]
) -> None:
    # It must not be over before the signal comes, however long a busy machine takes.
    job = submit(http, done_job["dataset_id"], steps=4000, step_ms=50)["id"]
    process = subprocess.Popen(
        [*PROGRAM, "wait", job, "--url", service.url],
        stderr=subprocess.PIPE,
        stdout=subprocess.PIPE,
        text=True,
    )
    assert process.stderr is not None
    process.stderr.readline()  # it follows
    time.sleep(0.2)
    process.send_signal(signal.SIGINT)
    _, said = process.communicate(timeout=30)
    assert process.returncode == exit_codes.SIGINT
    assert f"biresnerf wait '{service.url}/#/jobs/{job}'" in said
    assert f"biresnerf cancel '{service.url}/#/jobs/{job}'" in said
    reached = http.get(f"/v1/jobs/{job}").json()
    assert reached["state"] in {"queued", "running"}
    until(http, job, lambda found: found["progress"]["step"] > reached["progress"]["step"])
    http.post(f"/v1/jobs/{job}/cancel").raise_for_status()
    assert finished(http, job)["state"] == "cancelled"
