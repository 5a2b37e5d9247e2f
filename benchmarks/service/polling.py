"""How soon the API tells many clients of one job while that job has all cores: `python -m benchmarks.service.polling`.

The clients ask for the status as often as the answers tell them to, over connections that stay open. The same clients
ask in three parts of one run, of a real job, with real settings: while the job waits and the machine does nothing else;
while it runs and gives way (`BIRESNERF_JOB_NICE`, as installed); and while it runs and does not.
"""

from __future__ import annotations

import argparse
import asyncio
import contextlib
import json
import os
import random
import shutil
import sys
import time
from pathlib import Path
from typing import Any

import psutil

from benchmarks.chaos.__main__ import new_folder
from benchmarks.chaos.installation import Installation, Kept
from benchmarks.load.__main__ import ready
from benchmarks.load.calls import Calls, spread
from biresnerf.data.synthetic.scene import write_synthetic_scene
from workers.settings.settings import Settings

PRODUCTION = {"beat_s": 10.0, "stall_s": 60.0, "poll_s": 2.0, "janitor_s": 5.0}
OPTIONS = {"preset": "balanced", "start": "given", "steps": 1_000_000, "coarse_steps_max": 900_000}
LIMIT_MS = 250.0
STARTED_S = 120.0


async def _dataset(calls: Calls, folder: Path) -> str:
    scene = folder / "scene"
    write_synthetic_scene(scene, 12, 96, seed=0)
    url = (await calls("createDataset", "POST", "/v1/datasets", json={"name": "polled"})).headers["location"]
    for path in sorted(path for path in scene.rglob("*") if path.is_file()):
        name = path.relative_to(scene).as_posix()
        (await calls("putFile", "PUT", f"{url}/files/{name}", content=path.read_bytes())).raise_for_status()
    (await calls("finalizeDataset", "POST", f"{url}/finalize")).raise_for_status()
    while (found := (await calls("getDataset", "GET", url)).json())["state"] != "ready":
        if found["state"] == "rejected":
            raise RuntimeError(f"the scene was rejected: {found['error']}")
        await asyncio.sleep(0.2)
    return str(found["id"])


async def _client(port: int, job: str, offset_s: float, end: float, took: list[float]) -> None:
    """One client on a bare socket: it takes so little time that the machine is left to service and job."""
    request = f"GET /v1/jobs/{job} HTTP/1.1\r\nHost: 127.0.0.1:{port}\r\n\r\n".encode()
    reader, writer = await asyncio.open_connection("127.0.0.1", port)
    await asyncio.sleep(offset_s)
    while time.perf_counter() < end:
        began = time.perf_counter()
        writer.write(request)
        head = (await reader.readuntil(b"\r\n\r\n")).decode().lower()
        fields = dict(line.split(": ", 1) for line in head.split("\r\n")[1:] if line)
        await reader.readexactly(int(fields["content-length"]))
        took.append(time.perf_counter() - began)
        if not head.startswith("http/1.1 200"):
            raise RuntimeError(head)
        await asyncio.sleep(max(0.0, float(fields["retry-after"]) + began - time.perf_counter()))
    writer.close()


async def _poll(installation: Installation, job: str, clients: int, seconds: float) -> dict[str, Any]:
    """The clients' times, and what the job's process got of the machine meanwhile."""
    took: list[float] = []
    chance, before = random.Random(1), _cpu_s(installation)
    end = time.perf_counter() + seconds
    port = installation.ports[0]
    await asyncio.gather(*(_client(port, job, chance.uniform(0.0, 2.0), end, took) for _ in range(clients)))
    cores = {
        name: round((now - before.get(name, 0.0)) / seconds, 2) for name, now in _cpu_s(installation).items()
    }
    return {**spread(took), "per_s": round(len(took) / seconds, 1), "cores": cores}


def _cpu_s(installation: Installation) -> dict[str, float]:
    """Processor time so far of the API, the database, the job and the clients, in seconds."""
    roots = {
        "api": [kept.pid for kept in installation.replicas],
        "database": [installation.postgres.process.pid if installation.postgres.process else None],
        "job": [kept.pid for kept in installation.workers],
        "clients": [os.getpid()],
    }
    found = {}
    for name, pids in roots.items():
        times = 0.0
        for pid in filter(None, pids):
            process = psutil.Process(pid)
            below = [] if name == "clients" else process.children(recursive=True)
            for one in (process, *below):
                with contextlib.suppress(psutil.Error):
                    spent = one.cpu_times()
                    # of those that ended, too
                    times += spent.user + spent.system + spent.children_user + spent.children_system
        found[name] = times
    return found


async def _while_it_runs(
    installation: Installation, calls: Calls, dataset: str, asked: argparse.Namespace, nice: int
) -> dict[str, Any]:
    worker = Kept(
        f"nice{nice}",
        (sys.executable, "-m", "workers.queue.slot", "--slot", "cpu0"),
        {"BIRESNERF_JOB_NICE": str(nice), "OMP_NUM_THREADS": str(os.cpu_count())},
    )
    body = {"dataset_id": dataset, "options": OPTIONS}
    job = (await calls("submitJob", "POST", "/v1/jobs", json=body)).json()["id"]
    installation.add(worker)
    began = time.perf_counter()
    while (now := (await calls("getJob", "GET", f"/v1/jobs/{job}")).json())["progress"]["step"] < 20:
        if time.perf_counter() - began > STARTED_S or now["state"] in ("failed", "succeeded"):
            raise RuntimeError(f"the job does not run: {now}")
        await asyncio.sleep(0.5)
    found = await _poll(installation, job, asked.clients, asked.seconds)
    after = (await calls("getJob", "GET", f"/v1/jobs/{job}")).json()
    found["steps"] = after["progress"]["step"] - now["progress"]["step"]
    await calls("cancelJob", "POST", f"/v1/jobs/{job}/cancel")
    while (await calls("getJob", "GET", f"/v1/jobs/{job}")).json()["state"] == "running":
        await asyncio.sleep(0.2)
    await installation.remove(worker)
    return found


async def measure(folder: Path, asked: argparse.Namespace) -> dict[str, Any]:
    """The three parts."""
    usual = Settings.model_fields
    installation = Installation(folder, 1, 0, **PRODUCTION, job_command=usual["job_command"].default)
    found: dict[str, Any] = {}
    async with installation:
        calls = Calls(f"http://127.0.0.1:{installation.ports[0]}")
        await ready(calls)
        dataset = await _dataset(calls, folder)
        body = {"dataset_id": dataset, "options": OPTIONS}
        waiting = (await calls("submitJob", "POST", "/v1/jobs", json=body)).json()["id"]
        found["quiet"] = await _poll(installation, waiting, asked.clients, asked.seconds)
        await calls("cancelJob", "POST", f"/v1/jobs/{waiting}/cancel")
        for name, nice in (("job that gives way", usual["job_nice"].default), ("job that does not", 0)):
            found[name] = await _while_it_runs(installation, calls, dataset, asked, nice)
        await calls.http.aclose()
    return found


def main() -> int:
    parser = argparse.ArgumentParser(description="Exit status 0 where p99 stays below 250 ms beside a job.")
    parser.add_argument("--clients", type=int, default=200)
    parser.add_argument("--seconds", type=float, default=30.0, help="Of each part.")
    parser.add_argument("--output", type=Path, default=Path("polling.json"))
    asked = parser.parse_args()
    folder = new_folder()
    try:
        found = asyncio.run(measure(folder, asked))
    finally:
        shutil.rmtree(folder, ignore_errors=True)
    asked.output.write_text(json.dumps(found, indent=1) + "\n")
    for name, row in found.items():
        print(f"{name:22}{row['n']:>7} answers{row['p50_ms']:>9.1f}{row['p99_ms']:>9.1f}{row['max_ms']:>9.1f} ms"
              f"  cores {row['cores']}  steps {row.get('steps', '-')}")  # fmt: skip
    return 0 if found["job that gives way"]["p99_ms"] < LIMIT_MS else 1


if __name__ == "__main__":
    sys.exit(main())
