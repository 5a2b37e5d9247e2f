"""`biresnerf.client`, blocking and asynchronous, against the running service."""

from __future__ import annotations

import functools
import hashlib
import json
import socket
import threading
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any
from urllib.parse import urlsplit

import anyio.from_thread
import httpx
import pytest

from biresnerf.client import AsyncClient, Client, JobNotOver, Sending, ServiceError, StreamEvent
from biresnerf.errors import InputError
from biresnerf.wire.jobs import JobView
from tests.service.client.relay import Relay
from tests.service.conftest import Running, finished, scene_files, submit

QUICK = {"preset": "fast", "steps": 20, "seed": 5}


class Awaited:
    """An `AsyncClient` as if it were blocking."""

    def __init__(self, portal: anyio.from_thread.BlockingPortal, client: AsyncClient) -> None:
        self._portal, self._client = portal, client

    def __getattr__(self, name: str) -> Callable[..., Any]:
        method = getattr(self._client, name)
        return lambda *given, **named: self._portal.call(functools.partial(method, *given, **named))

    def events(self, job_id: str) -> list[StreamEvent]:
        async def gathered() -> list[StreamEvent]:
            return [event async for event in self._client.events(job_id)]

        return self._portal.call(gathered)


@pytest.fixture(params=["blocking", "asynchronous"])
def client(request: pytest.FixtureRequest, service: Running) -> Iterator[Any]:
    if request.param == "blocking":
        with Client(service.url) as blocking:
            yield blocking
        return
    with anyio.from_thread.start_blocking_portal() as portal:
        asynchronous = portal.call(lambda: _made(service.url))
        yield Awaited(portal, asynchronous)
        portal.call(asynchronous.close)


async def _made(url: str) -> AsyncClient:
    return AsyncClient(url)


def test_a_folder_becomes_a_job_and_its_result_a_folder(
    client: Any, http: httpx.Client, scene: Path, tmp_path: Path
) -> None:
    steps: list[Sending] = []
    seen: list[JobView] = []
    job = client.submit(scene, QUICK, labels={"run": "client"}, on_progress=steps.append)
    assert list(dict.fromkeys(step.step for step in steps)) == ["reading", "sending", "checking", "queueing"]
    assert steps[-2].bytes_sent == steps[-2].bytes_missing
    over = client.wait(job.id, seen.append)
    assert (over.state, over.labels, over.options["steps"]) == (
        *("succeeded", {"name": scene.name, "run": "client"}, 20),
    )
    assert [job.progress.fraction for job in seen] == sorted(job.progress.fraction for job in seen)
    kinds = [event.kind for event in client.events(job.id)]
    assert (kinds[0], kinds[-1]) == ("queued", "succeeded")

    done: list[int] = []
    files = client.download_all(job.id, tmp_path / "out", on_bytes=lambda more, _: done.append(more))
    found = {item["name"]: item for item in http.get(job.links.artifacts).json()["items"]}
    assert {path.relative_to(tmp_path / "out").as_posix() for path in files} == set(found)
    for name, item in found.items():
        content = (tmp_path / "out" / name).read_bytes()
        assert hashlib.sha256(content).hexdigest() == item["sha256"], name
    assert sum(done) == sum(item["size"] for item in found.values())
    # Again: everything is there.
    assert client.download_all(job.id, tmp_path / "out", on_bytes=lambda more, _: done.append(1)) == files
    assert sum(done) == sum(item["size"] for item in found.values())

    assert client.report(job.id).verdict.verdict == "kept_input"
    assert [row.name for row in client.images(job.id, sort="-moved_deg", limit=2).items] == ["b", "c"]
    assert [line.n for line in client.log(job.id)] == [1, 2]
    assert [line.text for line in client.log(job.id, after=1)] == ["line 2"]
    link = client.share(job.id, "poses.json", valid_s=60)
    assert httpx.get(link.href).content == (tmp_path / "out/poses.json").read_bytes()
    export = client.wait(client.export(job.id, ["kitti"]).id)
    assert [one.id for one in client.exports(job.id)] == [export.id]
    assert client.export(job.id, ["kitti"]).id == export.id
    assert "kitti.txt" in [artifact.name for artifact in client.artifacts(job.id)]
    client.delete_job(job.id)
    with pytest.raises(ServiceError) as gone:
        client.job(job.id)
    assert (gone.value.code, gone.value.status) == ("not_found", 404)
    client.delete_dataset(job.dataset_id)


def test_the_service_tells_of_itself_and_of_what_it_has(client: Any, done_job: dict[str, Any]) -> None:
    assert client.ready() is True
    assert client.info().limits.max_files == 120
    assert "fast" in client.options().presets
    assert done_job["id"] in [job.id for job in client.jobs(state="succeeded")]
    assert len(client.jobs(limit=1)) == 1
    assert client.jobs(label=("run", "nothing has this")) == []
    dataset = client.dataset(done_job["dataset_id"])
    assert dataset.id in [one.id for one in client.datasets(state="ready")]
    assert len(client.dataset_files(dataset.id)) == dataset.files


def test_webhooks_are_made_changed_tried_and_deleted(client: Any) -> None:
    made = client.create_webhook("http://127.0.0.1:9/in", ["job.failed"], description="mine")
    assert made.secret.startswith("whsec_")
    assert made.id in [one.id for one in client.webhooks()]
    assert client.change_webhook(made.id, description="yours").description == "yours"
    assert client.webhook(made.id).events == ("job.failed",)
    assert client.rotate_webhook_secret(made.id).secret != made.secret
    sent = client.test_webhook(made.id)
    assert [one.id for one in client.deliveries(made.id)] == [sent.id]
    assert client.delivery(made.id, sent.id).event == "webhook.test"
    client.delete_webhook(made.id)
    with pytest.raises(ServiceError):
        client.webhook(made.id)


def test_an_error_says_everything_the_service_said(client: Any, done_job: dict[str, Any]) -> None:
    with pytest.raises(ServiceError) as caught:
        client.images(done_job["id"], sort="beauty")
    error = caught.value
    assert (error.code, error.status, error.users_fault) == ("invalid_request", 422, True)
    assert [field.pointer for field in error.errors] == ["/query/sort"]
    assert error.detail in str(error)
    assert error.request_id
    with pytest.raises(InputError, match="unknown option"):
        client.fork(done_job["id"], {"stepz": 1})
    with pytest.raises(ServiceError) as refused:
        client.fork(done_job["id"], {"warmup_steps": 50})
    assert refused.value.code == "fork_not_possible"


def test_waiting_ends_when_its_time_is_up_and_the_job_goes_on(
    client: Any, http: httpx.Client, done_job: dict[str, Any]
) -> None:
    job = submit(http, done_job["dataset_id"], steps=4000, step_ms=20)["id"]
    seen: list[JobView] = []
    with pytest.raises(JobNotOver) as caught:
        client.wait(job, seen.append, timeout_s=0.4)
    assert caught.value.job_id == job
    assert seen
    assert client.cancel(job).state in {"queued", "running", "cancelled"}
    assert client.wait(job, timeout_s=60.0).state == "cancelled"


def test_nobody_at_the_address_is_said_at_once(tmp_path: Path) -> None:
    with socket.socket() as taken:
        taken.bind(("127.0.0.1", 0))
        with Client(f"http://127.0.0.1:{taken.getsockname()[1]}") as nobody:
            assert nobody.ready() is False
            with pytest.raises(ServiceError, match="biresnerf up") as caught:
                nobody.job("job_1")
    assert (caught.value.code, caught.value.status, caught.value.retryable) == ("unreachable", 0, True)


class LosesAnAnswer(Relay):
    """Passes a request on and breaks the connection in place of its answer, once when armed."""

    def __init__(self, target_port: int) -> None:
        super().__init__(target_port)
        self.armed = threading.Event()

    def _pump(self, source: socket.socket, sink: socket.socket, counted: bool) -> None:
        if counted:
            super()._pump(source, sink, counted)
            return
        try:
            while data := source.recv(256 * 1024):
                if self.armed.is_set():
                    self.armed.clear()
                    self.cut()
                    break
                sink.sendall(data)
        except OSError:
            pass
        for end in (source, sink):
            self._open.discard(end)
            end.close()


@pytest.fixture
def losing(service: Running) -> Iterator[tuple[Client, LosesAnAnswer]]:
    port = urlsplit(service.url).port
    assert port is not None
    relay = LosesAnAnswer(port)
    with Client(f"http://127.0.0.1:{relay.port}") as through:
        assert through.ready()
        yield through, relay
    relay.close()


def test_a_job_whose_answer_was_lost_is_there_once(
    losing: tuple[Client, LosesAnAnswer], http: httpx.Client, done_job: dict[str, Any]
) -> None:
    through, relay = losing
    relay.armed.set()
    job = through.create_job(done_job["dataset_id"], QUICK, labels={"answer": "lost"})
    assert not relay.armed.is_set()
    found = http.get("/v1/jobs", params={"label": "answer:lost"}).json()["items"]
    assert [item["id"] for item in found] == [job.id]
    finished(http, job.id)


def test_what_must_not_be_done_twice_is_not_asked_for_twice(losing: tuple[Client, LosesAnAnswer]) -> None:
    through, relay = losing
    relay.armed.set()
    with pytest.raises(ServiceError, match="No service answers"):
        through.create_webhook("http://127.0.0.1:9/once")
    (made,) = [one for one in through.webhooks() if one.url.endswith("/once")]
    through.delete_webhook(made.id)


def test_an_interrupted_submission_goes_on_in_the_same_dataset(
    service: Running, http: httpx.Client, scene: Path, tmp_path: Path
) -> None:
    other = tmp_path / "other"  # with bytes that the service has not seen
    for name, content in scene_files(scene).items():
        (other / name).parent.mkdir(parents=True, exist_ok=True)
        (other / name).write_bytes(content + (b"\n" if name.endswith(".json") else b""))
    stopped: list[Sending] = []

    def stop_while_sending(sending: Sending) -> None:
        stopped.append(sending)
        if sending.step == "checking":
            raise KeyboardInterrupt

    with Client(service.url) as client:
        with pytest.raises(KeyboardInterrupt):
            client.submit(other, QUICK, on_progress=stop_while_sending)
        left = stopped[-1].dataset_id
        assert left is not None
        assert client.dataset(left).state == "open"
        again: list[Sending] = []
        job = client.submit(other, QUICK, resume=left, on_progress=again.append)
        assert (job.dataset_id, again[1].files_missing) == (left, 0)
        # Who was interrupted after the job was queued gets that job, not a second one.
        assert client.submit(other, QUICK, resume=left).id == job.id
        another = client.submit(other, QUICK, resume=left, labels={"run": "again"})
        assert another.id != job.id
        client.cancel(another.id)
        client.wait(job.id)


def test_an_interrupted_download_goes_on_where_it_broke_off(
    service: Running, done_job: dict[str, Any], tmp_path: Path
) -> None:
    with Client(service.url) as client:
        (video,) = [one for one in client.artifacts(done_job["id"]) if one.name == "renders/orbit.mp4"]
        target = tmp_path / "orbit.mp4"
        part = tmp_path / f".orbit.mp4.{video.sha256[:12]}.part"
        whole = httpx.get(service.url + video.href).content
        part.write_bytes(whole[:4000])
        counted: list[int] = []
        client.download(video, target, on_bytes=counted.append)
        assert (target.read_bytes(), counted[0], sum(counted)) == (whole, 4000, len(whole))
        # What lies there of something else is found by the digest, and nothing is left of it.
        part.write_bytes(bytes(4000))
        with pytest.raises(ServiceError, match="damaged"):
            client.download(video, tmp_path / "orbit.mp4")
        assert [path.name for path in tmp_path.iterdir()] == ["orbit.mp4"]


def test_files_in_the_way_are_kept_and_names_choose(
    service: Running, done_job: dict[str, Any], tmp_path: Path
) -> None:
    (tmp_path / "poses.json").write_text("mine")
    with Client(service.url) as client:
        with pytest.raises(InputError, match="other content"):
            client.download_all(done_job["id"], tmp_path)
        assert [path.name for path in tmp_path.iterdir()] == ["poses.json"]
        chosen = client.download_all(done_job["id"], tmp_path, names=["colmap", "r*.json"])
        names = sorted(path.relative_to(tmp_path).as_posix() for path in chosen)
        assert names == [f"colmap/sparse/0/{table}.bin" for table in ("cameras", "images", "points3D")] + [
            "report.json"
        ]
        client.download_all(done_job["id"], tmp_path, names=["poses.json"], replace=True)
        assert json.loads((tmp_path / "poses.json").read_text())["format"] == "biresnerf-poses"
        with pytest.raises(InputError, match="no file of the result"):
            client.download_all(done_job["id"], tmp_path, names=["nothing.txt"])
