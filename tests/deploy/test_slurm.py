"""deploy/slurm on a real cluster of one node: workers for what waits, and jobs that outlive their allocations."""

from __future__ import annotations

import asyncio
import os
import shlex
import subprocess
import sys
import time
from collections import Counter
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest

from tests.deploy.slurm_cluster import PATIENCE_S, SlurmCluster, lacking
from tests.deploy.slurm_submission import SUBMIT
from tests.workers.conftest import ROOT, Counting, environment, quick_settings, short_folder
from workers.engine import Stores
from workers.settings.settings import Settings

pytestmark = [
    pytest.mark.anyio,
    pytest.mark.skipif("BIRESNERF_TEST_SLURM" not in os.environ, reason="Slurm is run by make slurm-check"),
]
CPUS_OF_NODE, CPUS_OF_WORKER = 8, 2
NAME = "biresnerf-cpu"
STALL_S = 6.0


@pytest.fixture(scope="module")
def cluster() -> Iterator[SlurmCluster]:
    if os.getuid() != 0:
        pytest.skip("Slurm is run by make slurm-check as root")
    if lacking():
        pytest.skip(f"Slurm is not installed: {lacking()}")
    with short_folder() as folder, SlurmCluster(folder, CPUS_OF_NODE) as started:
        yield started


@pytest.fixture
def settings(database_url: str, tmp_path: Path) -> Settings:
    return quick_settings(tmp_path / "data", database_url=database_url, stall_s=STALL_S)


class Fleet:
    """Submits workers as cron would, and remembers how many."""

    def __init__(self, cluster: SlurmCluster, settings: Settings, folder: Path) -> None:
        self.cluster, self._folder, self.submitted = cluster, folder, 0
        self.seen: Counter[str] = Counter()
        program = folder / "biresnerf"
        program.write_text(f'#!/bin/sh\nexec {sys.executable} -m biresnerf.command_line "$@"\n')
        program.chmod(0o755)
        own = {key: value for key, value in environment(settings).items() if key.startswith("BIRESNERF_")}
        own |= {"BIRESNERF": str(program), "BIRESNERF_IDLE_EXIT_S": "5", "PYTHONPATH": str(ROOT)}
        (folder / "worker.env").write_text("".join(f"{k}={shlex.quote(v)}\n" for k, v in own.items()))
        self._variables = {
            **{key: value for key, value in cluster.variables.items() if not key.startswith("BIRESNERF_")},
            "BIRESNERF_QUEUE_URL": str(settings.database_url),
            "BIRESNERF_WORKER_SETTINGS": str(folder / "worker.env"),
        }

    def submit(self, most: int, *options: str) -> int:
        """One round; how many workers it added to Slurm's queue."""
        log = f"--output={self._folder}/worker-%A_%a.log"
        said = subprocess.run(
            [sys.executable, str(SUBMIT), "--most", str(most), "--", log, *options],
            env=self._variables, capture_output=True, text=True, timeout=PATIENCE_S, check=False,
        )  # fmt: skip
        assert said.returncode == 0, said
        number = int(said.stdout.split()[-2])
        self.submitted += number
        return number

    def running(self) -> list[str]:
        """Ids of workers that have an allocation."""
        return [job for job, state in self.cluster.jobs() if state == "RUNNING"]

    async def until_all_over(self, stores: Stores, jobs: list[str], most: int) -> None:
        """Rounds of submission until every job is final and no worker is left."""
        end = time.monotonic() + 4 * PATIENCE_S
        while not await all_final(stores, jobs) or self.cluster.jobs():
            assert time.monotonic() < end, (self.cluster.jobs(), self.logs())
            self.submit(most)
            states = self.cluster.states()
            assert states.total() <= most
            self.seen |= states
            await asyncio.sleep(0.5)

    def logs(self) -> str:
        return "\n".join(log.read_text()[-800:] for log in sorted(self._folder.glob("worker-*.log")))


@pytest.fixture
def fleet(cluster: SlurmCluster, settings: Settings, tmp_path: Path) -> Iterator[Fleet]:
    yield Fleet(cluster, settings, tmp_path)
    cluster.run("scancel", "--me", check=False)
    for job, _ in cluster.jobs():
        cluster.until_gone(job)


async def all_final(stores: Stores, jobs: list[str]) -> bool:
    return all([(await stores.jobs.get(job)).final for job in jobs])


async def assert_each_ended_once(counting: Counting, jobs: list[str], steps: int) -> None:
    for counting.id in jobs:
        job = await counting.stores.jobs.get(counting.id)
        assert job.state == "succeeded", job.error
        await counting.assert_one_result(steps)


async def until(holds: Callable[[], object], what: str) -> None:
    end = time.monotonic() + PATIENCE_S
    while not holds():
        assert time.monotonic() < end, f"waited too long until {what}"
        await asyncio.sleep(0.2)


async def test_twenty_jobs_get_a_worker_each_and_never_one_too_many(
    counting: Counting, fleet: Fleet, stores: Stores, settings: Settings
):
    jobs = [await counting.submit(20, 0.05) for _ in range(20)]
    assert fleet.submit(6) == 6
    assert fleet.submit(6) == 0, "as many as there may be are submitted"
    await fleet.until_all_over(stores, jobs, most=6)
    assert fleet.submitted == 20, "one for each job"
    assert fleet.seen["RUNNING"] == CPUS_OF_NODE // CPUS_OF_WORKER
    assert fleet.seen["PENDING"] >= 2
    await assert_each_ended_once(counting, jobs, 20)
    assert len(counting.starts()) == 20
    names = {path.name.rpartition(".")[2] for path in (settings.data_dir / "slots").iterdir()}
    assert names <= {f"cpu{n}" for n in range(6)}, "names are used again"


async def test_two_that_wait_together_with_a_worker_submit_one_more(counting: Counting, fleet: Fleet):
    await counting.submit(200, 0.05)
    assert fleet.submit(6, "--hold") == 1
    await counting.submit(200, 0.05)
    assert fleet.submit(6, "--hold") == 1
    assert fleet.submit(6, "--hold") == 0
    assert fleet.cluster.states() == {"PENDING": 2}


async def test_a_cancelled_allocation_costs_its_job_no_attempt(
    counting: Counting, fleet: Fleet, stores: Stores
):
    await counting.submit(200, 0.05, checkpoint_every=10**6)
    assert fleet.submit(1) == 1
    await counting.until(lambda job: job.progress.step >= 10)
    (worker,) = fleet.running()
    fleet.cluster.run("scancel", worker)
    fleet.cluster.until_gone(worker)
    assert (await stores.jobs.get(counting.id)).state == "queued"
    await fleet.until_all_over(stores, [counting.id], most=1)
    assert fleet.submitted == 2
    assert counting.starts()[1]["from"] >= 10, "from the checkpoint that SIGTERM asked for"
    assert (await stores.jobs.get(counting.id)).attempt == 1
    await assert_each_ended_once(counting, [counting.id], 200)


async def test_a_requeued_allocation_goes_on_without_another_submission(
    counting: Counting, fleet: Fleet, stores: Stores
):
    await counting.submit(200, 0.05, checkpoint_every=10**6)
    assert fleet.submit(1, "--requeue") == 1
    await counting.until(lambda job: job.progress.step >= 10)
    (worker,) = fleet.running()
    fleet.cluster.run("scontrol", "requeue", worker)
    # Until then Slurm calls it COMPLETING, as a worker that does not come back.
    await until(lambda: fleet.cluster.states() == {"PENDING": 1}, "the worker waits again")
    assert (await stores.jobs.get(counting.id)).state == "queued"
    await fleet.until_all_over(stores, [counting.id], most=1)
    assert fleet.submitted == 1
    assert counting.starts()[1]["from"] >= 10
    assert (await stores.jobs.get(counting.id)).attempt == 1
    await assert_each_ended_once(counting, [counting.id], 200)


async def test_a_killed_node_daemon_and_a_lost_node_lose_none_of_twenty_jobs(
    counting: Counting, fleet: Fleet, stores: Stores
):
    long = [await counting.submit(800, 0.05) for _ in range(4)]
    short = [await counting.submit(60, 0.05) for _ in range(16)]
    fleet.submit(6)
    await until(lambda: len(counting.starts()) == 4, "four have started")
    fleet.cluster.kill_node_daemon()
    fleet.cluster.until_node_is_down()
    fleet.cluster.start_node()
    before = len(counting.starts())
    fleet.submit(6)
    await until(lambda: len(counting.starts()) >= before + 3, "three more have started")
    assert fleet.cluster.lose_node() >= 9, "three workers, their steps and their jobs"
    fleet.cluster.until_node_is_down()
    fleet.cluster.start_node()
    await fleet.until_all_over(stores, long + short, most=6)
    starts = len(counting.starts())
    assert starts >= 20 + 3, "jobs were interrupted"
    await assert_each_ended_once(counting, long, 800)
    await assert_each_ended_once(counting, short, 60)
    sys.stdout.write(f"\n{starts} starts of 20 jobs, {fleet.submitted} workers submitted\n")
