"""All on one machine: the supervisor, its private database and its slots, each killed in the middle of a job."""

from __future__ import annotations

import asyncio
import contextlib
import os
import signal
import subprocess
import sys
import time
from collections.abc import AsyncIterator, Iterator
from pathlib import Path

import psutil
import pytest

from tests.workers.conftest import (
    ROOT,
    SHORT_STALL,
    Counting,
    Slots,
    environment,
    quick_settings,
    short_folder,
)
from workers.database.postgres_binaries import unprivileged_user
from workers.engine import open_stores
from workers.settings.settings import Settings

pytestmark = [pytest.mark.server, pytest.mark.anyio]
PROGRAM = Path(__file__).with_name("up_program.py")
START_S = END_S = 90.0  # on a machine that has much else to do
# Nobody is taken for dead who merely got no processor for seconds.
PATIENT = {"stall_s": 20.0, "beat_s": 1.0}


class Up:
    """One installation with its private database."""

    def __init__(self, folder: Path, slots: Slots) -> None:
        self._folder, self._slots = folder, slots
        self.settings = quick_settings(folder / "data", **SHORT_STALL)
        self.process: subprocess.Popen[bytes] | None = None

    async def start(self, *arguments: str) -> Settings:
        """Start it and wait until it is ready; the settings of a client."""
        log = self._folder / "up.log"
        before = log.read_text().count("ready ") if log.exists() else 0
        self.process = self._slots.run(self.settings, [sys.executable, str(PROGRAM), *arguments], log)
        end = time.monotonic() + START_S
        while log.read_text().count("ready ") <= before:
            assert time.monotonic() < end, log.read_text()
            assert self.process.poll() is None, log.read_text()
            await asyncio.sleep(0.05)
        url = [line for line in log.read_text().splitlines() if line.startswith("ready ")][-1].split()[1]
        return self.settings.model_copy(update={"database_url": url})

    def descendants(self) -> list[psutil.Process]:
        assert self.process is not None
        return psutil.Process(self.process.pid).children(recursive=True)

    def one(self, word: str) -> psutil.Process:
        """The descendant whose command line has ``word``."""
        (found,) = [
            p
            for p in self.descendants()
            if word in " ".join(p.cmdline()) and p.parent() == psutil.Process(self.process.pid)
        ]
        return found


@pytest.fixture
def up(slots: Slots) -> Iterator[Up]:
    with short_folder() as folder:
        yield (installation := Up(folder, slots))
        if installation.process is not None and installation.process.poll() is None:
            installation.process.terminate()
            with contextlib.suppress(subprocess.TimeoutExpired):
                installation.process.wait(15)


@contextlib.asynccontextmanager
async def opened(client: Settings, journal: Path) -> AsyncIterator[Counting]:
    async with open_stores(client) as stores:
        yield Counting(stores, journal)


async def test_kill_9_of_the_database_in_mid_job_is_survived(up: Up, tmp_path: Path):
    up.settings = up.settings.model_copy(update=PATIENT)
    client = await up.start()
    async with opened(client, tmp_path / "journal") as counting:
        await counting.submit(100, 0.05)
        await counting.until(lambda job: job.progress.step >= 20)
        postmaster = up.one("postgres")
        postmaster.kill()
        job = await counting.until_final()
        assert (job.state, job.attempt) == ("succeeded", 1), "the job did not even notice"
        assert len(counting.starts()) == 1
        assert (await counting.events()).count("succeeded") == 1
        assert (await counting.result())["steps"] == 100
        await counting.submit(3, 0.01)
        assert (await counting.until_final()).state == "succeeded", "the slot takes the next job"
    assert up.process is not None
    assert up.process.poll() is None


async def test_an_outage_longer_than_the_stall_time_takes_no_job_from_a_living_worker(up: Up, tmp_path: Path):
    up.settings = up.settings.model_copy(update={"slots": 2})
    client = await up.start()
    async with opened(client, tmp_path / "journal") as counting:
        await counting.submit(140, 0.05)
        await counting.until(lambda job: job.progress.step >= 10)
        postmaster = up.one("postgres")
        os.kill(up.process.pid, signal.SIGSTOP)  # nobody starts the database again
        postmaster.kill()
        await asyncio.sleep(2.5 * up.settings.stall_s)
        os.kill(up.process.pid, signal.SIGCONT)
        job = await counting.until_final()
        assert (job.state, job.attempt) == ("succeeded", 1)
        assert len(counting.starts()) == 1


async def test_kill_9_of_the_slot_resumes_the_job_at_once(up: Up, tmp_path: Path):
    client = await up.start()
    async with opened(client, tmp_path / "journal") as counting:
        await counting.submit(60, 0.05)
        await counting.until(lambda job: job.progress.step >= 15)
        up.one("workers.queue.slot").kill()
        job = await counting.until_final()
        assert (job.state, job.attempt) == ("succeeded", 2)
        assert int(counting.starts()[1]["from"]) >= 10


async def test_kill_9_of_the_supervisor_leaves_nothing_and_the_next_one_goes_on(up: Up, tmp_path: Path):
    client = await up.start()
    async with opened(client, tmp_path / "journal") as counting:
        await counting.submit(60, 0.05)
        await counting.until(lambda job: job.progress.step >= 15)
        family = up.descendants()
        assert len(family) > 3
        up.process.kill()
        up.process.wait()
        _, alive = psutil.wait_procs(family, timeout=END_S)
        assert alive == []
        # What a power cut leaves behind: the pid of a process that is somebody else's now.
        pid_file = up.settings.postgres_dir / "data" / "postmaster.pid"
        bystander = subprocess.Popen(["sleep", "60"], user=unprivileged_user())
        pid_file.write_text(f"{bystander.pid}\n{up.settings.postgres_dir}/data\n1700000000\n5432\n\n\n0 0\n")
        await up.start()
        job = await counting.until_final()
        assert bystander.poll() is None, "the innocent process lives"
        bystander.kill()
        bystander.wait()
        assert (job.state, job.attempt) == ("succeeded", 2)
        assert int(counting.starts()[1]["from"]) >= 10


async def test_sigterm_drains_and_ends_everything(up: Up, tmp_path: Path):
    up.settings = up.settings.model_copy(update=PATIENT)
    client = await up.start()
    async with opened(client, tmp_path / "journal") as counting:
        await counting.submit(1000, 0.05)
        await counting.until(lambda job: job.progress.step >= 5)
    family = up.descendants()
    up.process.send_signal(signal.SIGTERM)
    assert await asyncio.to_thread(up.process.wait, END_S) == 0
    assert not any(process.is_running() for process in family)
    client = await up.start()
    async with open_stores(client) as stores:
        (job,) = (await stores.jobs.list()).items
        assert job.attempt <= 1, "the drained attempt was not counted"
        await stores.jobs.cancel(job.id)


async def test_a_broken_child_ends_the_whole_with_status_1(up: Up):
    await up.start("--broken")
    assert await asyncio.to_thread(up.process.wait, END_S) == 1
    assert "giving up" in (up._folder / "up.log").read_text()


async def test_a_second_installation_in_the_same_folder_is_refused(up: Up, slots: Slots):
    await up.start()
    second = subprocess.run(
        [sys.executable, "-c", _START_ANOTHER],
        env=environment(up.settings),
        capture_output=True,
        text=True,
        cwd=ROOT,
    )
    assert second.stdout.strip() == "already_running"
    assert up.process.poll() is None


_START_ANOTHER = """
from workers.database.embedded_postgres import EmbeddedPostgres
from workers.settings.errors import SetupError
from workers.settings.settings import Settings
try:
    EmbeddedPostgres(Settings().postgres_dir).start()
except SetupError as error:
    print(error.code)
"""


async def test_the_servers_socket_is_for_nobody_else(up: Up):
    client = await up.start()
    assert "host=" in str(client.database_url)
    socket = up.settings.postgres_dir / ".s.PGSQL.5432"
    assert socket.stat().st_mode & 0o077 == 0
    assert up.settings.postgres_dir.stat().st_mode & 0o077 == 0
    listening = [c for c in up.one("postgres").net_connections(kind="inet") if c.status == psutil.CONN_LISTEN]
    assert listening == []
    assert os.geteuid() != 0 or socket.stat().st_uid != 0
