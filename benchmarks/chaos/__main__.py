"""The command: `python -m benchmarks.chaos --help`."""

from __future__ import annotations

import argparse
import asyncio
import contextlib
import json
import math
import os
import random
import shutil
import sys
import tempfile
import time
from collections import Counter
from collections.abc import AsyncIterator
from pathlib import Path
from typing import Any

from benchmarks.chaos.clients import Clients
from benchmarks.chaos.faults import Faults
from benchmarks.chaos.installation import Installation, free_port
from benchmarks.chaos.real_clients import RealClients
from benchmarks.chaos.surroundings import ObjectStore, SmallDisk, Surroundings, WrongClock, lacking
from benchmarks.chaos.verdict import Claim, claims_about_jobs, claims_about_rest, told
from workers.database.database import open_database
from workers.store.trash import RETRY_S


@contextlib.asynccontextmanager
async def surroundings(folder: Path) -> AsyncIterator[Surroundings]:
    """The disk, object store and clock of a storm with real jobs."""
    disk, store = SmallDisk(folder / "disk"), ObjectStore(free_port(), free_port(), folder / "store.log")
    try:
        async with store.serving():
            yield Surroundings(disk, store, WrongClock(folder))
    finally:
        disk.unmount()


async def storm(
    folder: Path,
    *,
    jobs: int,
    workers: int,
    every_s: float,
    seed: int,
    at_once: int = 8,
    within_s: float = math.inf,
    around: Surroundings | None = None,
) -> tuple[list[Claim], dict[str, Any]]:
    """Run jobs under faults; returns the claims and what happened. With ``around``, jobs are real."""
    began = time.monotonic()
    installation = Installation(folder, replicas=2, workers=workers, around=around)
    kind = Clients if around is None else RealClients
    clients = kind(installation.ports, folder, random.Random(seed))
    over = asyncio.Event()
    async with installation:
        await clients.prepare()
        faults = Faults(installation, random.Random(seed + 1), every_s)
        failing = asyncio.create_task(faults.run(over))
        try:
            await clients.run(jobs, at_once, within_s)
        finally:
            over.set()
            await failing
        seconds = time.monotonic() - began
        claims = claims_about_jobs(clients)
        async with open_database(installation.postgres.url, connections=2) as database:
            # A folder that received a file during its deletion is retried later.
            patience_s = RETRY_S + 20 + 4 * installation.settings.stall_s
            claims += await claims_about_rest(installation, database, patience_s)
    claims.append(Claim("no process is left", installation.left_over()))
    states = Counter(f"{seen.kind}: {seen.job['state']}" for seen in clients.seen)
    happened = {
        "seconds": round(seconds, 1),
        "faults": dict(faults.done),
        "answers": {str(key): value for key, value in clients.answers.items()},
        "states": dict(states),
        "attempts": sum(sum(e["type"] == "started" for e in seen.events) for seen in clients.seen),
        "restarts": {kept.name: kept.starts - 1 for kept in installation.replicas + installation.workers},
    }
    sys.stdout.write(told(claims, faults.done, clients.answers, seconds) + f"\n{dict(states)}\n")
    return claims, happened


def new_folder() -> Path:
    """A folder in memory if there is room: on a busy disk, the database starts more slowly than workers stall."""
    memory = Path("/dev/shm")
    roomy = memory.is_dir() and os.access(memory, os.W_OK) and shutil.disk_usage(memory).free > 2**30
    folder = Path(tempfile.mkdtemp(prefix="biresnerf-chaos-", dir=memory if roomy else None))
    folder.chmod(0o711)  # PostgreSQL's user must be able to enter
    return folder


async def real_storm(folder: Path, **asked: Any) -> tuple[list[Claim], dict[str, Any]]:
    """A storm with real refinements, a small disk and an object store; raises `SystemExit` if these are unavailable."""
    if missing := lacking():
        raise SystemExit(f"A storm with real jobs needs {', '.join(missing)}.")
    async with surroundings(folder) as around:
        return await storm(folder, around=around, **asked)


def main() -> int:
    parser = argparse.ArgumentParser(description="Jobs under random faults; exit status 0 where all held.")
    parser.add_argument("--jobs", type=int, default=200)
    parser.add_argument("--workers", type=int, default=2)
    parser.add_argument("--every", type=float, default=3.0, help="Seconds between two faults, on average.")
    parser.add_argument("--minutes", type=float, default=math.inf, help="After these no job is submitted.")
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--output", type=Path, default=Path("chaos.json"))
    parser.add_argument("--real", action="store_true", help="Refine photos; more can fail then. Needs root.")
    parser.add_argument("--keep", action="store_true", help="Leave the folder with logs and files.")
    asked = parser.parse_args()
    folder = new_folder()
    begin = real_storm if asked.real else storm
    try:
        claims, happened = asyncio.run(
            begin(
                folder,
                jobs=asked.jobs,
                workers=asked.workers,
                every_s=asked.every,
                seed=asked.seed,
                within_s=60 * asked.minutes,
            )
        )
    finally:
        if asked.keep:
            sys.stdout.write(f"all is in {folder}\n")
        else:
            shutil.rmtree(folder, ignore_errors=True)
    passed = not any(claim.broken for claim in claims)
    settings = {
        "real": asked.real,
        "jobs": asked.jobs,
        "workers": asked.workers,
        "every_s": asked.every,
        "seed": asked.seed,
    }
    verdict = {"passed": passed, **settings, **happened, "claims": {c.name: c.broken for c in claims}}
    asked.output.write_text(json.dumps(verdict, indent=1) + "\n")
    sys.stdout.write(f"{'passed' if passed else 'FAILED'}; written to {asked.output}\n")
    return 0 if passed else 1


if __name__ == "__main__":
    sys.exit(main())
