"""The containers of deploy/kubernetes as processes: their arguments, variables, secrets, probes and signals.

The cluster's part is played here: KEDA's query and its arithmetic, a pod's folders, SIGTERM and the grace period.
"""

from __future__ import annotations

import asyncio
import contextlib
import importlib.util
import json
import os
import re
import signal
import subprocess
import sys
import time
import uuid
from collections.abc import Callable, Iterator, Mapping
from pathlib import Path
from types import ModuleType

import httpx
import psycopg
import pytest

from tests.deploy.custom_schemas import workers_to_start
from tests.deploy.manifests import ROOT, Manifest, container, only, pod_templates, rendered
from tests.service.free_port import free_port
from tests.workers.buckets import by_boto, environment_of, fresh_bucket, moto_server
from tests.workers.conftest import PATIENCE_S, Counting, Slots, environment, quick_settings
from workers.engine import open_stores
from workers.process.exit_status import ExitStatus
from workers.settings.settings import Settings

pytestmark = pytest.mark.anyio
SCALED = "biresnerf-worker"
PAGE = (ROOT / "docs/kubernetes.md").read_text("utf-8")
METRICS_TOKEN = "of-those-who-scrape"


@pytest.fixture(scope="module")
def bucket() -> Iterator[Mapping[str, str]]:
    with moto_server() as endpoint:
        yield environment_of(fresh_bucket(endpoint))


@pytest.fixture
def settings(database_url: str, tmp_path: Path, bucket: Mapping[str, str]) -> Settings:
    """Of whoever looks from outside; pods have a folder of their own and share the bucket."""
    own = {**bucket, "storage_url": f"{bucket['storage_url']}/{tmp_path.name}"}
    return quick_settings(tmp_path / "outside", database_url=database_url, **own)


class Cluster:
    """Starts a pod's container as a process, in the environment that its manifest describes."""

    def __init__(self, settings: Settings, slots: Slots, folder: Path) -> None:
        self._settings, self._slots, self._folder = settings, slots, folder
        self._secrets = folder / "secrets"
        self._secrets.mkdir()
        for key in ("database_url", "storage_access_key_id", "storage_secret_access_key"):
            (self._secrets / key).write_text(str(getattr(settings, key)))
        (self._secrets / "metrics_token").write_text(METRICS_TOKEN)
        self.pods: list[tuple[subprocess.Popen[bytes], Path]] = []

    def start(self, template: Manifest, **changes: str) -> tuple[subprocess.Popen[bytes], Path]:
        """The process, and the pod's /var/lib/biresnerf."""
        scratch = self._folder / f"pod{len(self.pods)}"
        manifests = rendered("cpu")
        one = container(template)
        said = dict(only(manifests, "ConfigMap", "biresnerf-settings")["data"])
        for item in one["env"]:
            said[item["name"]] = item.get("value", "1").replace("/run/secrets/biresnerf", str(self._secrets))
        # What the test's speed, bucket and image are: the rest is the manifest's.
        quick = environment(self._settings)
        for name in ("BEAT_S", "POLL_S", "JANITOR_S", "JOB_COMMAND", "STORAGE_URL", "STORAGE_ENDPOINT"):
            said[f"BIRESNERF_{name}"] = quick[f"BIRESNERF_{name}"]
        said |= {"BIRESNERF_DATA_DIR": str(scratch), "BIRESNERF_HOST": "0.0.0.0", "PYTHONPATH": str(ROOT)}
        inherited = {key: value for key, value in os.environ.items() if not key.startswith("BIRESNERF_")}
        with (self._folder / f"pod{len(self.pods)}.log").open("ab") as log:
            process = subprocess.Popen(
                [sys.executable, "-m", "biresnerf.command_line", *self._on_volumes(one["args"][1:])],
                env={**inherited, **said, **changes},
                stdout=log,
                stderr=log,
                start_new_session=True,
            )
        self._slots.processes.append(process)
        self.pods.append((process, scratch))
        return process, scratch

    def _on_volumes(self, words: list[str]) -> list[str]:
        return [word.replace("/backups", str(self._folder / "backups")) for word in words]


@pytest.fixture
def cluster(settings: Settings, slots: Slots, tmp_path: Path) -> Cluster:
    return Cluster(settings, slots, tmp_path)


@pytest.fixture(scope="module")
def worker() -> Manifest:
    return dict(pod_templates(rendered("cpu")))[SCALED]


def waiting(scaler: psycopg.Connection, overlay: str = "cpu") -> int:
    """What KEDA reads: the first column of the first row of the trigger's query."""
    (trigger,) = only(rendered(overlay), "ScaledJob", SCALED)["spec"]["triggers"]
    return int(scaler.execute(trigger["metadata"]["query"].encode()).fetchone()[0])


def health() -> ModuleType:
    """deploy/health.py, which the container runs for its probes."""
    spec = importlib.util.spec_from_file_location("health", ROOT / "deploy/health.py")
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def is_ready(scratch: Path) -> bool:
    return health().trouble_of_worker(scratch / "slots") == ""


def is_alive(scratch: Path, silence_s: float) -> bool:
    return health().trouble_of_loop(scratch / "beats", silence_s) == ""


async def until(holds, what: str) -> None:
    end = time.monotonic() + PATIENCE_S
    while not holds():
        assert time.monotonic() < end, f"waited too long until {what}"
        await asyncio.sleep(0.1)


async def test_each_waiting_job_gets_a_worker_and_each_worker_ends_with_its_job(
    counting: Counting, cluster: Cluster, worker: Manifest, scaler: psycopg.Connection
):
    assert waiting(scaler) == waiting(scaler, "gpu") == 0
    jobs = [await counting.submit(10, 0.05) for _ in range(3)]
    assert waiting(scaler) == waiting(scaler, "gpu") == 3
    for _ in range(60):  # KEDA's rounds, with room for two workers
        unfinished = [(process, scratch) for process, scratch in cluster.pods if process.poll() is None]
        pending = sum(not is_ready(scratch) for _, scratch in unfinished)
        for _ in range(workers_to_start(waiting(scaler), len(unfinished), pending, most=2)):
            cluster.start(worker)
        if not unfinished and waiting(scaler) == 0 and cluster.pods:
            break
        await asyncio.sleep(1.0)
    states = [(await counting.stores.jobs.get(job)).state for job in jobs]
    assert states == ["succeeded"] * 3
    ends = [process.wait() for process, _ in cluster.pods]
    assert ends.count(ExitStatus.DONE) == 3
    assert set(ends) <= {ExitStatus.DONE, ExitStatus.NO_JOB}
    assert len(counting.starts()) == 3


async def test_an_evicted_worker_ends_in_time_and_the_next_one_goes_on_from_its_checkpoint(
    counting: Counting, cluster: Cluster, worker: Manifest, scaler: psycopg.Connection
):
    await counting.submit(60, 0.05, checkpoint_every=1000)
    evicted, scratch = cluster.start(worker)
    await counting.until(lambda job: job.progress.step >= 10)
    assert is_ready(scratch)
    assert is_alive(scratch, 60.0)
    assert waiting(scaler) == 0
    evicted.terminate()
    grace_s = worker["spec"]["terminationGracePeriodSeconds"]
    assert await asyncio.to_thread(evicted.wait, grace_s) == ExitStatus.STOPPED
    assert waiting(scaler) == 1
    after, _ = cluster.start(worker)
    assert await asyncio.to_thread(after.wait, PATIENCE_S) == ExitStatus.DONE
    assert counting.starts()[1]["from"] >= 10, "from the checkpoint, which came through the bucket"
    job = await counting.stores.jobs.get(counting.id)
    assert (job.state, job.attempt) == ("succeeded", 1)
    await counting.assert_one_result(60)


async def test_the_probes_of_a_web_process_are_answered(cluster: Cluster, tmp_path: Path):
    """As the kubelet asks: with the pod's address as the host, and without a key."""
    template = dict(pod_templates(rendered("cpu")))["biresnerf-api"]
    port = free_port()
    process, _ = cluster.start(template, BIRESNERF_PORT=str(port))
    headers = {"host": f"10.42.0.17:{port}", "user-agent": "kube-probe/1.32"}
    with httpx.Client(base_url=f"http://127.0.0.1:{port}", headers=headers) as kubelet:
        asked = [
            container(template)[f"{name}Probe"]["httpGet"]["path"]
            for name in ("startup", "liveness", "readiness")
        ]

        def answers() -> list[int]:
            try:
                return [kubelet.get(path).status_code for path in asked]
            except httpx.TransportError:
                return []

        await until(lambda: answers() == [200, 200, 200], "all probes succeed")
        assert kubelet.get("/v1/jobs").status_code == 401
        assert kubelet.get("/metrics").status_code == 401
        token = {"authorization": f"Bearer {METRICS_TOKEN}"}
        assert 'biresnerf_queue_waiting{kind="cpu"}' in kubelet.get("/metrics", headers=token).text
        process.terminate()
        grace_s = template["spec"]["terminationGracePeriodSeconds"]
        # uvicorn ends in order, then passes the signal on to the process.
        assert await asyncio.to_thread(process.wait, grace_s) in (0, -signal.SIGTERM)
        assert "Application shutdown complete" in (tmp_path / "pod0.log").read_text()


async def test_the_other_pods_end_as_their_manifests_expect(cluster: Cluster, tmp_path: Path):
    pods = dict(pod_templates(rendered("cpu")))
    migrate, _ = cluster.start(pods["biresnerf-migrate"])
    assert await asyncio.to_thread(migrate.wait, PATIENCE_S) == 0
    dispatcher, scratch = cluster.start(pods["biresnerf-dispatcher"])
    await until(lambda: "dispatcher is ready" in (tmp_path / "pod1.log").read_text(), "it is ready")
    # Two beats late is frozen, for a test.
    assert is_alive(scratch, 12.0)
    dispatcher.send_signal(signal.SIGSTOP)
    await until(lambda: not is_alive(scratch, 12.0), "nobody takes a frozen one for alive")
    dispatcher.send_signal(signal.SIGCONT)
    await until(lambda: is_alive(scratch, 12.0), "it goes on")
    dispatcher.terminate()
    grace_s = pods["biresnerf-dispatcher"]["spec"]["terminationGracePeriodSeconds"]
    assert await asyncio.to_thread(dispatcher.wait, grace_s) == 0


@pytest.fixture
def loses(server: str) -> Iterator[Callable[[], str]]:
    """Drops a database of its own where there is one, and gives the address of a new one."""
    name = f"lost_{uuid.uuid4().hex[:12]}"
    with psycopg.connect(server, autocommit=True) as connection:

        def drop() -> None:
            connection.execute(f"DROP DATABASE IF EXISTS {name} WITH (FORCE)".encode())

        def lose() -> str:
            drop()
            connection.execute(f"CREATE DATABASE {name}".encode())
            return server.replace("/postgres?", f"/{name}?")

        yield lose
        drop()


def job_that_restores() -> Manifest:
    """The pod that the page makes of the CronJob's."""
    template = dict(pod_templates(rendered("cpu")))["biresnerf-backup"]
    (patch,) = re.findall(r"kubectl patch --local -f - --type json .*\n +-p '(\[.*\])'", PAGE)
    job = {
        "apiVersion": "batch/v1",
        "kind": "Job",
        "metadata": {"name": "restore"},
        "spec": {"template": template},
    }
    command = ["kubectl", "patch", "--local", "-f", "-", "--type", "json", "-p", patch, "-o", "json"]
    done = subprocess.run(command, input=json.dumps(job), capture_output=True, text=True, check=True)
    restored: Manifest = json.loads(done.stdout)["spec"]["template"]
    return restored


async def test_after_database_and_bucket_are_lost_the_backup_brings_back_jobs_files_and_keys(
    loses: Callable[[], str], bucket: Mapping[str, str], slots: Slots, tmp_path: Path
):
    place = fresh_bucket(bucket["storage_endpoint"])
    settings = quick_settings(tmp_path / "outside", database_url=loses(), **environment_of(place))
    cluster, pods = Cluster(settings, slots, tmp_path), dict(pod_templates(rendered("cpu")))

    async def ends_well(template: Manifest) -> None:
        process, _ = cluster.start(template)
        assert await asyncio.to_thread(process.wait, PATIENCE_S) == 0

    async def told(key: str, *paths: str) -> dict[str, bytes]:
        """What the service answers, and the files of the result."""
        port = free_port()
        process, _ = cluster.start(pods["biresnerf-api"], BIRESNERF_PORT=str(port))
        with httpx.Client(
            base_url=f"http://127.0.0.1:{port}", headers={"authorization": f"Bearer {key}"}
        ) as client:

            def is_up() -> bool:
                with contextlib.suppress(httpx.TransportError):
                    return client.get("/readyz").status_code == 200
                return False

            await until(is_up, "the web process is ready")
            found = {path: client.get(path).raise_for_status().content for path in paths}
            for item in client.get(paths[-1]).json()["items"]:
                found[item["href"]] = client.get(item["href"]).raise_for_status().content
        process.terminate()
        await asyncio.to_thread(process.wait, PATIENCE_S)
        return found

    await ends_well(pods["biresnerf-migrate"])
    async with open_stores(settings) as stores:
        counting = Counting(stores, tmp_path / "journal")
        done = await counting.submit(3, 0.01)
        await ends_well(pods[SCALED])
        waits = await counting.submit(3, 0.01)
        _, key = await stores.keys.create("local", "mine", ["read"])
    asked = (f"/v1/jobs/{done}", f"/v1/jobs/{waits}", "/v1/datasets", f"/v1/jobs/{done}/artifacts")
    before = await told(key, *asked)
    assert len(before) == len(asked) + 3
    await ends_well(pods["biresnerf-backup"])

    loses()
    for item in by_boto(place).list_objects_v2(Bucket=place.name)["Contents"]:
        by_boto(place).delete_object(Bucket=place.name, Key=item["Key"])
    await ends_well(job_that_restores())
    assert await told(key, *asked) == before
    await ends_well(pods[SCALED])
    async with open_stores(settings) as stores:
        assert (await stores.jobs.get(waits)).state == "succeeded"
