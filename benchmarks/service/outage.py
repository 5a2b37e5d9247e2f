"""The database goes away in mid job, at production's timings: ``python -m benchmarks.service.outage --seconds 45``.

Exit status 0 where the job was started once and succeeded, with the right result.
"""

from __future__ import annotations

import argparse
import asyncio
import json
import random
import shutil
import signal
import sys
import time
from pathlib import Path

from benchmarks.chaos.__main__ import new_folder
from benchmarks.chaos.clients import Clients, Seen
from benchmarks.chaos.installation import Installation
from benchmarks.chaos.verdict import Claim, claims_about_jobs
from workers.settings.settings import Settings

BEFORE_S = 5.0
AFTER_S = 20.0
STEP_S = 0.25
TIMINGS = ("beat_s", "stall_s", "poll_s", "janitor_s", "stop_grace_s", "max_attempts")


async def outage(folder: Path, seconds: float) -> list[Claim]:
    """One job, two workers of which one is idle, no database for a while."""
    timings = {name: Settings.model_fields[name].default for name in TIMINGS}
    journal = folder / "journal"
    steps = round((BEFORE_S + seconds + AFTER_S) / STEP_S)
    plan = {"steps": steps, "step_s": STEP_S, "seed": "outage", "journal": str(journal)}
    async with Installation(folder, 1, 2, **timings) as installation:
        clients = Clients(installation.ports, folder, random.Random(1))
        seen = Seen("good", plan)
        clients.seen = [seen]
        living = asyncio.create_task(clients.submit_and_follow(seen))
        while not journal.exists():
            await asyncio.sleep(0.1)
        await asyncio.sleep(BEFORE_S)
        assert installation.postgres.process is not None, "started"
        installation.postgres.process.send_signal(signal.SIGINT)
        while installation.postgres.alive:
            await asyncio.sleep(0.05)
        away = time.monotonic()
        await asyncio.sleep(seconds)
        installation.postgres.start()
        print(f"the database was away for {time.monotonic() - away:.1f} s")
        await living
    starts = [json.loads(line) for line in journal.read_text().splitlines()]
    print(f"the job {seen.job['state']} in attempt {seen.job['attempt']} after {len(starts)} start")
    once = [] if len(starts) == seen.job["attempt"] == 1 else [f"starts: {starts}"]
    return [*claims_about_jobs(clients), Claim("the job was started once", once)]


def main() -> int:
    parser = argparse.ArgumentParser(description="One job over an outage of the database.")
    parser.add_argument("--seconds", type=float, default=45.0)
    folder = new_folder()
    try:
        claims = asyncio.run(outage(folder, parser.parse_args().seconds))
    finally:
        shutil.rmtree(folder, ignore_errors=True)
    for claim in claims:
        print(f"{'BROKEN' if claim.broken else 'held'}: {claim.name} {' '.join(claim.broken)}")
    return int(any(claim.broken for claim in claims))


if __name__ == "__main__":
    sys.exit(main())
