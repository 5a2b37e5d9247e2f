"""The command: `python -m benchmarks.load --help`."""

from __future__ import annotations

import argparse
import asyncio
import contextlib
import json
import shutil
import sys
from pathlib import Path
from typing import Any

import httpx

from benchmarks.chaos.__main__ import new_folder
from benchmarks.chaos.installation import Installation, Kept
from benchmarks.load import parts
from benchmarks.load.calls import Calls, Process
from workers.database import job_queue
from workers.database.database import open_database
from workers.engine import open_stores

DO_NOTHING = (sys.executable, "-I", "-S", "-c", "pass")


async def measure(folder: Path, asked: argparse.Namespace) -> dict[str, Any]:
    """All parts, one after the other."""
    production = {"beat_s": 10.0, "stall_s": 60.0, "poll_s": 2.0, "janitor_s": 5.0}
    installation = Installation(
        folder, 1, 0, **production, max_queued=asked.jobs + 1000, job_command=DO_NOTHING
    )
    found: dict[str, Any] = {}

    def tell(name: str, figures: Any) -> None:
        found[name] = figures
        sys.stdout.write(f"{name}: {json.dumps(figures)}\n")
        sys.stdout.flush()

    async with installation:
        calls = Calls(f"http://127.0.0.1:{installation.ports[0]}")
        await ready(calls)
        process = Process(installation.replicas[0].pid or 0)
        dataset = await parts.ready_dataset(calls)
        async with (
            open_stores(installation.settings) as stores,
            open_database(installation.postgres.url, connections=2) as database,
        ):
            tell("idle", {"memory_mib": process.mib()})
            await parts.fill(database, dataset, asked.jobs - 2 * asked.submitted)
            tell("enqueue", await parts.enqueue(calls, process, stores, dataset, asked.submitted))
            tell("lists", await parts.lists(calls, asked.jobs))
            tell("uploads", await parts.uploads(calls, process, asked.uploads, asked.mib))
            rows = await database.fetch("SELECT id FROM jobs ORDER BY created_at DESC LIMIT 1000")
            jobs = [row["id"] for row in rows]
            for spread_over in (50, 1):
                some = jobs[:spread_over]
                heard = await parts.listeners(calls, process, database, some, asked.listeners, asked.seconds)
                tell(f"listeners to {spread_over}", heard)
            hour = await parts.an_hour(calls, process, jobs, dataset, asked.requests, 60 * asked.minutes)
            tell("an hour", hour)
            await database.fetch("UPDATE jobs SET state = 'cancelled' WHERE state = 'queued'")
            for row in await database.fetch("SELECT id FROM queue_entries WHERE state = 'todo'"):
                async with database.transaction() as connection:
                    await job_queue.cancel(connection, row["id"])
            await start_workers(installation, asked.workers)
            tell("dispatch", await parts.dispatch(calls, dataset, asked.dispatched))
        tell("endpoints", calls.table())
        tell("refused", calls.refused[:20])
        await calls.http.aclose()
    return found


async def ready(calls: Calls) -> None:
    """Wait for the API."""
    while True:
        with contextlib.suppress(httpx.TransportError):
            if (await calls.http.get("/readyz")).status_code == 200:
                return
        await asyncio.sleep(0.2)


async def start_workers(installation: Installation, count: int) -> None:
    """Start workers beside the running API."""
    for n in range(count):
        installation.add(Kept(f"worker{n}", (sys.executable, "-m", "workers.queue.slot", "--slot", f"w{n}")))
    await asyncio.sleep(3.0)


def main() -> int:
    parser = argparse.ArgumentParser(description="What one API process and the queue carry.")
    parser.add_argument("--jobs", type=int, default=10_000)
    parser.add_argument("--submitted", type=int, default=1000, help="Of these over HTTP, and by the library.")
    parser.add_argument("--uploads", type=int, default=200, help="At the same time.")
    parser.add_argument("--mib", type=int, default=4, help="Of each upload.")
    parser.add_argument("--listeners", type=int, default=500)
    parser.add_argument("--seconds", type=float, default=20.0, help="Of changes to be heard.")
    parser.add_argument("--requests", type=int, default=36_000, help="An hour's, at ten a second.")
    parser.add_argument("--minutes", type=float, default=0.0, help="That these take; 0: as fast as they go.")
    parser.add_argument("--workers", type=int, default=2)
    parser.add_argument("--dispatched", type=int, default=100)
    parser.add_argument("--output", type=Path, default=Path("load.json"))
    asked = parser.parse_args()
    folder = new_folder()
    try:
        found = asyncio.run(measure(folder, asked))
    finally:
        shutil.rmtree(folder, ignore_errors=True)
    asked.output.write_text(json.dumps(found, indent=1) + "\n")
    print(f"\n{'endpoint':38}{'n':>7}{'p50':>10}{'p99':>10}{'longest':>11}  (ms)")
    for name, row in found["endpoints"].items():
        print(f"{name:38}{row['n']:>7}{row['p50_ms']:>10.1f}{row['p99_ms']:>10.1f}{row['max_ms']:>11.1f}")
    return 0


if __name__ == "__main__":
    sys.exit(main())
