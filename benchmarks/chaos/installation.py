"""A whole installation as child processes: PostgreSQL, API replicas, workers; they are restarted when they end."""

from __future__ import annotations

import asyncio
import contextlib
import json
import os
import signal
import socket
import sys
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path

import psutil

from benchmarks.chaos.surroundings import RESERVE_BYTES, Surroundings
from biresnerf.wire.datasets import CheckReport
from workers.database.embedded_postgres import EmbeddedPostgres
from workers.database.migrate import migrate
from workers.process.die_with_parent import dying_with_parent
from workers.settings.settings import Settings

ROOT = Path(__file__).parents[2]
PROGRAM = ROOT / "tests" / "workers" / "counting_program.py"
_FOUND = CheckReport(
    images=1, with_pose=1, without_pose=0, poses="given", cameras=1, camera_models=("PINHOLE",),
    intrinsics=("given",), format="colmap", masks=0, transparency=False, warnings=(),
)  # fmt: skip
CHECK = f"print({json.dumps({'report': _FOUND.model_dump(mode='json')})!r})"
PAUSE_S = 0.3  # pause before a restart, as by a container's restart policy


def free_port() -> int:
    """A port that is free at the moment."""
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        port: int = probe.getsockname()[1]
        return port


def quick_settings(data_dir: Path, database_url: str, **changes: object) -> Settings:
    """Settings with short intervals in place of production's; jobs run the counting program."""
    values: dict[str, object] = {
        "data_dir": data_dir,
        "database_url": database_url,
        "beat_s": 0.5,
        "stall_s": 3.0,
        "poll_s": 0.5,
        "janitor_s": 0.5,
        "stop_grace_s": 5.0,
        # When files that a killed API process stored but did not record are deleted.
        "upload_expiry_s": 15.0,
        # Good jobs are hit by faults repeatedly; jobs that always crash must still fail soon.
        "max_attempts": 12,
        # Jobs must not give way to other work on the machine.
        "job_nice": 0,
        "job_command": (sys.executable, str(PROGRAM)),
        "check_command": (sys.executable, "-S", "-c", CHECK),
    }
    return Settings(**{**values, **changes})


@dataclass
class Kept:
    """A process that is started again whenever it ends."""

    name: str
    command: Sequence[str]
    variables: dict[str, str] = field(default_factory=dict)
    process: asyncio.subprocess.Process | None = None
    starts: int = 0
    wanted: bool = True

    @property
    def pid(self) -> int | None:
        """The PID of the running process."""
        alive = self.process is not None and self.process.returncode is None
        return self.process.pid if alive and self.process is not None else None


REAL_PROGRAMS = {name: Settings.model_fields[name].default for name in ("job_command", "check_command")}


def real_settings(around: Surroundings) -> dict[str, object]:
    """Changes to `quick_settings` for real jobs: loading their libraries takes all cores for seconds."""
    waits = {"beat_s": 1.0, "stall_s": 6.0}
    return {**REAL_PROGRAMS, **waits, "disk_reserve_bytes": RESERVE_BYTES, **around.store.settings()}


class Installation:
    """Starts everything in ``folder``; `ports` are the API replicas'. Use as an async context manager.

    With ``around``, jobs and checks are real, files are in its store, scratch folders on its disk, and the first worker
    has its clock.
    """

    def __init__(
        self,
        folder: Path,
        replicas: int,
        workers: int,
        around: Surroundings | None = None,
        **settings: object,
    ) -> None:
        self.folder, self.around = folder, around
        data_dir = folder / "data"
        if around is not None:
            settings, data_dir = {**real_settings(around), **settings}, around.disk.folder / "data"
        self.postgres = EmbeddedPostgres(folder / "postgres")
        self.settings = quick_settings(data_dir, self.postgres.url, **settings)
        self._job_program = self.settings.job_command[-1]
        self.ports = [free_port() for _ in range(replicas)]
        self.replicas = [
            Kept(f"api{n}", (sys.executable, "-m", "service.server"), {"BIRESNERF_PORT": str(port)})
            for n, port in enumerate(self.ports)
        ]
        self.workers = [
            Kept(f"worker{n}", (sys.executable, "-m", "workers.queue.slot", "--slot", f"w{n}"))
            for n in range(workers)
        ]
        if around is not None:
            self.workers[0].variables = around.clock.variables()
        self._keeping: list[asyncio.Task[None]] = []
        self._closing = False

    async def __aenter__(self) -> Installation:
        self.postgres.start()
        migrate(self.postgres.url)
        for kept in self.replicas + self.workers:
            self._keeping.append(asyncio.create_task(self._keep(kept)))
        return self

    async def __aexit__(self, *_: object) -> None:
        self._closing = True
        for kept in self.replicas + self.workers:
            if kept.pid is not None:
                os.kill(kept.pid, signal.SIGCONT)
                os.kill(kept.pid, signal.SIGTERM)
        try:
            async with asyncio.timeout(30):
                await asyncio.gather(*self._keeping)
        except TimeoutError:
            for kept in self.replicas + self.workers:
                if kept.pid is not None:
                    os.kill(kept.pid, signal.SIGKILL)
            await asyncio.gather(*self._keeping)
        finally:
            self.postgres.stop()

    def add(self, worker: Kept) -> None:
        """Add a worker."""
        self.workers.append(worker)
        self._keeping.append(asyncio.create_task(self._keep(worker)))

    async def remove(self, worker: Kept) -> None:
        """Stop a worker for good."""
        self.workers.remove(worker)
        worker.wanted = False
        if worker.process is not None and worker.pid is not None:
            os.kill(worker.pid, signal.SIGTERM)
            await worker.process.wait()

    async def _keep(self, kept: Kept) -> None:
        log = self.folder / f"{kept.name}.log"
        while kept.wanted and not self._closing:
            with log.open("ab") as output:
                # Children must not share the terminal as standard input.
                kept.process = await asyncio.create_subprocess_exec(
                    *dying_with_parent(list(kept.command), signal_number=signal.SIGKILL),
                    stdin=asyncio.subprocess.DEVNULL,
                    stdout=output,
                    stderr=output,
                    env=self.environment() | kept.variables,
                    start_new_session=True,
                    cwd=ROOT,
                )
            kept.starts += 1
            await kept.process.wait()
            await asyncio.sleep(PAUSE_S)

    def environment(self) -> dict[str, str]:
        """The environment of each process."""
        said = {
            f"BIRESNERF_{name.upper()}": value if isinstance(value, str) else json.dumps(value)
            for name, value in self.settings.model_dump(
                mode="json", exclude_none=True, exclude_defaults=True
            ).items()
        }
        return {**os.environ, **said, "PYTHONPATH": str(ROOT), "OMP_NUM_THREADS": "1"}

    def job_processes(self) -> list[int]:
        """The PIDs of job processes."""
        found = []
        for kept in self.workers:
            with contextlib.suppress(psutil.Error):
                for child in psutil.Process(kept.pid).children(recursive=True) if kept.pid else ():
                    if self._job_program in child.cmdline():
                        found.append(child.pid)
        return found

    def stored_keys(self) -> set[str]:
        """The keys of all files in the store."""
        if self.around is not None:
            return self.around.store.keys()
        root = self.settings.files_dir
        return {path.relative_to(root).as_posix() for path in root.rglob("*") if path.is_file()}

    def database_processes(self) -> list[int]:
        """The PIDs of the server and its backends."""
        assert self.postgres.process is not None, "started"
        with contextlib.suppress(psutil.NoSuchProcess):
            server = psutil.Process(self.postgres.process.pid)
            return [server.pid, *(child.pid for child in server.children())]
        return []

    def left_over(self) -> list[str]:
        """The command lines of processes that still run in our folder."""
        found = []
        for process in psutil.process_iter(["pid", "cmdline", "cwd", "status"]):
            words = " ".join(process.info["cmdline"] or ())
            ours = str(self.folder) in words or (process.info["cwd"] or "").startswith(str(self.folder))
            if ours and process.pid != os.getpid() and process.info["status"] != psutil.STATUS_ZOMBIE:
                found.append(words)
        return found
