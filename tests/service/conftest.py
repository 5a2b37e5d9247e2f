"""The whole service as users run it (`biresnerf up`: database, API, worker slot), once for all tests."""

from __future__ import annotations

import contextlib
import io
import json
import os
import shutil
import signal
import subprocess
import sys
import tempfile
import time
import zipfile
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any
from urllib.parse import unquote

import httpx
import pytest
from click.testing import CliRunner

from biresnerf.data.synthetic.scene import write_synthetic_scene
from service.commands.keys import keys_command
from service.commands.tenants import tenants_command
from workers.process.die_with_parent import dying_with_parent

PROGRAM = Path(__file__).with_name("quick_program.py")
MIB = 2**20
LIMITS = {
    "max_files": 120,
    "max_file_bytes": 2 * MIB,
    "max_archive_bytes": 6 * MIB,
    "max_unpacked_bytes": 40 * MIB,
    "max_dataset_bytes": 48 * MIB,
}
PATIENCE_S = 90.0


@dataclass(frozen=True)
class Running:
    """A running service."""

    url: str
    data_dir: Path
    process: subprocess.Popen[bytes]
    log: Path

    def staging_is_empty(self) -> bool:
        staging = self.data_dir / "staging"
        return not staging.exists() or not any(staging.iterdir())


@contextlib.contextmanager
def short_folder() -> Iterator[Path]:
    """A folder that PostgreSQL's user can reach, with a short path for its socket."""
    folder = Path(tempfile.mkdtemp(prefix="biresnerf-service-"))
    folder.chmod(0o711)
    try:
        yield folder
    finally:
        shutil.rmtree(folder, ignore_errors=True)


@contextlib.contextmanager
def running_service(folder: Path, **settings: Any) -> Iterator[Running]:
    """`biresnerf up` on a free port; ended by SIGINT, as Ctrl-C does."""
    values = {
        # Quick enough to be waited for; several services stand by while other tests want the processor.
        **{"beat_s": 1.0, "poll_s": 1.0, "janitor_s": 1.0, "expiry_s": 1.0},
        "stall_s": 10.0,  # a worker that gets no processor for seconds is not dead
        "data_dir": folder / "data",
        "job_nice": 0,  # tests wait for jobs, whatever else the machine does
        "log_level": "INFO",
        # Receivers of webhooks and senders of files live on this machine.
        "webhook_http": True,
        "webhook_ports": (),
        "webhook_networks": ("127.0.0.0/8",),
        "file_address_http": True,
        "file_address_ports": (),
        "file_address_networks": ("127.0.0.0/8",),
        **LIMITS,
        **settings,
    }
    said = {
        f"BIRESNERF_{name.upper()}": json.dumps(value) if isinstance(value, tuple) else str(value)
        for name, value in values.items()
    }
    log = folder / "up.log"
    command = [sys.executable, "-m", "biresnerf.command_line", "up", "--port", "0", "--slots", "1"]
    with log.open("wb") as output:
        process = subprocess.Popen(
            dying_with_parent(command, signal_number=signal.SIGINT),
            env={**os.environ, **said},
            stdout=subprocess.PIPE,
            stderr=output,
            start_new_session=True,
        )
    try:
        assert process.stdout is not None
        line = process.stdout.readline().decode()
        assert line.startswith("ready at "), log.read_text()
        yield Running(line.split()[2], folder / "data", process, log)
    finally:
        process.send_signal(signal.SIGINT)
        try:
            process.wait(30)
        except subprocess.TimeoutExpired:
            os.killpg(process.pid, signal.SIGKILL)
            process.wait()
            raise


@pytest.fixture(scope="session")
def service() -> Iterator[Running]:
    with (
        short_folder() as folder,
        running_service(folder, job_command=(sys.executable, str(PROGRAM))) as running,
    ):
        yield running


@pytest.fixture
def http(service: Running) -> Iterator[httpx.Client]:
    with httpx.Client(base_url=service.url, timeout=60.0) as client:
        yield client
        # Whatever a test sent, the service goes on.
        assert client.get("/readyz").status_code == 200
        assert service.staging_is_empty()


@pytest.fixture(scope="session")
def scene(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Six views of 32 px with their poses."""
    folder = tmp_path_factory.mktemp("scene")
    write_synthetic_scene(folder, n_views=6, size=32, seed=1)
    return folder


def scene_files(scene: Path, below: str = "") -> dict[str, bytes]:
    """The scene as names and bytes."""
    return {
        below + path.relative_to(scene).as_posix(): path.read_bytes()
        for path in sorted(scene.rglob("*"))
        if path.is_file()
    }


def zip_of(files: dict[str, bytes], compression: int = zipfile.ZIP_DEFLATED) -> bytes:
    buffer = io.BytesIO()
    with zipfile.ZipFile(buffer, "w", compression) as archive:
        for name, content in files.items():
            archive.writestr(zipfile.ZipInfo(name), content, compress_type=compression)
    return buffer.getvalue()


def problem(answer: httpx.Response, status: int, code: str) -> dict[str, Any]:
    """The body, once it has been seen to be a whole problem of this kind."""
    assert answer.headers["content-type"] == "application/problem+json", answer.text
    body: dict[str, Any] = answer.json()
    assert (answer.status_code, body["code"]) == (status, code), body
    assert body["status"] == status
    assert body["type"] == f"urn:biresnerf:problem:{code}"
    assert body["title"]
    assert body["detail"]
    assert unquote(body["instance"]) == answer.request.url.path
    assert body["request_id"] == answer.headers["x-request-id"]
    return body


def new_dataset(http: httpx.Client) -> str:
    answer = http.post("/v1/datasets", json={"name": "test"})
    assert answer.status_code == 201, answer.text
    assert answer.headers["location"] == f"/v1/datasets/{answer.json()['id']}"
    found: str = answer.json()["id"]
    return found


def upload(http: httpx.Client, dataset: str, content: bytes) -> httpx.Response:
    return http.post(f"/v1/datasets/{dataset}/archive", content=content)


def ready_dataset(http: httpx.Client, scene: Path) -> str:
    dataset = new_dataset(http)
    assert upload(http, dataset, zip_of(scene_files(scene))).status_code == 200
    answer = http.post(f"/v1/datasets/{dataset}/finalize")
    assert answer.status_code == 200, answer.text
    assert answer.json()["state"] == "ready"
    return dataset


def submit(
    http: httpx.Client, dataset: str, steps: int = 20, step_ms: int = 5, **options: Any
) -> dict[str, Any]:
    body = {"dataset_id": dataset, "options": {"preset": "fast", "steps": steps, "seed": step_ms, **options}}
    answer = http.post("/v1/jobs", json=body)
    assert answer.status_code == 202, answer.text
    found: dict[str, Any] = answer.json()
    return found


def dataset_ids(http: httpx.Client) -> list[str]:
    """Which datasets there are, the newest first; when they expire changes with the jobs of other tests."""
    return [item["id"] for item in http.get("/v1/datasets").json()["items"]]


def until(
    http: httpx.Client, job: str, holds: Callable[[dict[str, Any]], bool], patience_s: float = PATIENCE_S
) -> dict[str, Any]:
    """The job once ``holds``; fails the test after the timeout."""
    end = time.monotonic() + patience_s
    while True:
        found: dict[str, Any] = http.get(f"/v1/jobs/{job}").json()
        if holds(found):
            return found
        assert time.monotonic() < end, f"waited too long: {found}"
        time.sleep(0.05)


def finished(http: httpx.Client, job: str, patience_s: float = PATIENCE_S) -> dict[str, Any]:
    return until(http, job, lambda found: found["state"] in {"succeeded", "failed", "cancelled"}, patience_s)


@pytest.fixture(scope="session")
def done_job(service: Running, scene: Path) -> dict[str, Any]:
    """A job that is over, with its result."""
    with httpx.Client(base_url=service.url, timeout=60.0) as client:
        job = finished(client, submit(client, ready_dataset(client, scene))["id"])
    assert job["state"] == "succeeded", job
    return job


TUS = {"Tus-Resumable": "1.0.0", "Upload-Length": "9", "Upload-Offset": "0"}


def new_upload(http: httpx.Client) -> str:
    """A resumable upload that waits for its bytes."""
    made = http.post(f"/v1/datasets/{new_dataset(http)}/uploads", headers=TUS)
    assert made.status_code == 201, made.text
    return made.json()["id"]


def operator(data_dir: Path, *arguments: str) -> Any:
    """`biresnerf keys …` or `biresnerf tenants …` with `--json`, beside the running service."""
    said = CliRunner().invoke(
        {"keys": keys_command, "tenants": tenants_command}[arguments[0]],
        [*arguments[1:], "--json", "--data-dir", str(data_dir)],
        env={"BIRESNERF_DATABASE_URL": None},
        catch_exceptions=False,
    )
    assert said.exit_code == 0, said.output
    return json.loads(said.stdout)


def client_with(service: Running, key: str | None) -> httpx.Client:
    headers = {"Authorization": f"Bearer {key}"} if key else {}
    return httpx.Client(base_url=service.url, timeout=60.0, headers=headers)


BURST = 10**6


@pytest.fixture(scope="session")
def closed() -> Iterator[Running]:
    """A service that wants keys, and takes requests as fast as tests make them."""
    settings = {
        "auth": "required",
        "key_requests_burst": BURST,
        "job_command": (sys.executable, str(PROGRAM)),
    }
    with short_folder() as folder, running_service(folder, **settings) as running:
        yield running


@dataclass(frozen=True)
class Tenant:
    http: httpx.Client
    key: str
    dataset: str
    job: str
    upload: str
    webhook: str
    delivery: str
    link: str
    batch: str


@pytest.fixture(scope="session")
def tenants(closed: Running, scene: Path) -> Iterator[tuple[Tenant, Tenant]]:
    """Two tenants, each with a dataset and a finished job."""
    made = []
    for name in ("anna", "bert"):
        key = operator(closed.data_dir, "keys", "create", "test", "--tenant", name)["key"]
        http = client_with(closed, key)
        dataset = ready_dataset(http, scene)
        job = finished(http, submit(http, dataset)["id"])["id"]
        webhook = http.post("/v1/webhooks", json={"url": "http://127.0.0.1:9/in"}).json()["id"]
        delivery = http.post(f"/v1/webhooks/{webhook}/test").json()["id"]
        link = http.post(f"/v1/jobs/{job}/links", json={}).json()["id"]
        batch = http.post("/v1/batches", json={"jobs": [{"dataset_id": dataset}]}).json()
        http.post(batch["links"]["cancel"])
        finished(http, batch["jobs"][0]["id"])
        made.append(Tenant(http, key, dataset, job, new_upload(http), webhook, delivery, link, batch["id"]))
    yield made[0], made[1]
    for tenant in made:
        tenant.http.close()
