"""A backup under load, restored elsewhere: ``python -m benchmarks.service.restore [--jobs 60] [--workers 3]``.

Jobs run and clients submit more while the backup is made. Then the installation is lost, and a new one goes on with
what the backup holds. Exit status 0 where all held.
"""

from __future__ import annotations

import argparse
import asyncio
import json
import random
import shutil
import sys
import time
from collections import Counter
from pathlib import Path
from typing import Any

import psycopg
from psycopg.rows import dict_row

from benchmarks.chaos.__main__ import new_folder
from benchmarks.chaos.clients import Clients, Seen
from benchmarks.chaos.installation import Installation
from benchmarks.chaos.verdict import Claim, claims_about_jobs
from workers.database.embedded_postgres import EmbeddedPostgres
from workers.upkeep.backup import make_backup
from workers.upkeep.backup_folder import BackupIndex
from workers.upkeep.restore import restore_backup

_JOBS = "SELECT id, state, step, checkpoint IS NOT NULL AS saved, artifacts FROM jobs ORDER BY id"
Rows = dict[str, dict[str, Any]]


def planned(folder: Path, n: int, chance: random.Random) -> Seen:
    """A job of some seconds, with a checkpoint a second."""
    journal = str(folder / f"journal-{n}")
    return Seen(
        "good", {"steps": chance.randint(60, 160), "step_s": 0.05, "seed": f"{n}", "journal": journal}
    )


async def jobs_of(url: str) -> Rows:
    """The jobs' rows by id."""
    async with await psycopg.AsyncConnection.connect(url, row_factory=dict_row) as connection:
        return {row["id"]: row for row in await (await connection.execute(_JOBS)).fetchall()}


async def lose(folder: Path, jobs: int, workers: int) -> tuple[list[Seen], Rows, BackupIndex]:
    """The jobs submitted until the backup began, their rows at that moment, and the backup's index."""
    chance = random.Random(1)
    async with Installation(folder / "lost", 1, workers) as lost:
        clients = Clients(lost.ports, folder, chance)
        early = [planned(folder, n, chance) for n in range(jobs)]
        for seen in early:
            await clients.submit(seen)
        while (
            sum(row["state"] == "succeeded" for row in (await jobs_of(lost.postgres.url)).values())
            < jobs // 3
        ):
            await asyncio.sleep(0.2)
        before = await jobs_of(lost.postgres.url)
        late = [planned(folder, jobs + n, chance) for n in range(jobs // 3)]
        submitting = asyncio.gather(*map(clients.submit, late))
        began = time.monotonic()
        index = await make_backup(lost.settings, lost.postgres.url, folder / "backup")
        took_s = time.monotonic() - began
        await submitting
    size = sum(file.size for file in index.files)
    print(
        f"backup: {len(index.files)} files, {size / 1e6:.1f} MB, {took_s:.1f} s; {len(index.gone)} deleted meanwhile"
    )
    shutil.rmtree(folder / "lost")
    return early + late, before, index


async def restored(folder: Path) -> Rows:
    """The jobs' rows in the new installation, which does not run yet."""
    place = Installation(folder / "new", 1, 0)
    place.folder.mkdir(exist_ok=True)
    place.folder.chmod(0o711)
    postgres = EmbeddedPostgres(place.folder / "postgres")
    url = postgres.start()
    try:
        began = time.monotonic()
        await restore_backup(place.settings, url, folder / "backup")
        print(f"restore: {time.monotonic() - began:.1f} s")
        return await jobs_of(url)
    finally:
        postgres.stop()


async def rehearse(folder: Path, jobs: int, workers: int) -> list[Claim]:
    """Lose an installation, restore it, let it go on, and say what held."""
    (folder / "lost").mkdir()
    (folder / "lost").chmod(0o711)
    submitted, before, _ = await lose(folder, jobs, workers)
    starts_before = {seen.job["id"]: len(_starts(seen)) for seen in submitted}
    rows = await restored(folder)
    print(f"jobs in the backup: {dict(Counter(row['state'] for row in rows.values()))}")
    async with Installation(folder / "new", 1, workers) as new:
        clients = Clients(new.ports, folder, random.Random(2))
        clients.seen = [seen for seen in submitted if seen.job["id"] in rows]
        began = time.monotonic()
        await asyncio.gather(*map(clients.see_through, clients.seen))
        print(f"all over {time.monotonic() - began:.0f} s later")
        after = await jobs_of(new.postgres.url)
    running = [seen for seen in clients.seen if rows[seen.job["id"]]["state"] == "running"]
    saved = [seen for seen in running if rows[seen.job["id"]]["saved"]]
    print(f"of {len(running)} that ran, {len(saved)} had a checkpoint in the backup; the others started over")
    again = {seen.job["id"]: _starts(seen)[starts_before[seen.job["id"]] :] for seen in saved}
    published = {name: row["artifacts"] for name, row in before.items() if row["state"] == "succeeded"}
    return [
        Claim("every job submitted before the backup is there", sorted(before.keys() - rows.keys())),
        Claim(
            "every result published before it is the same",
            [name for name, artifacts in published.items() if after[name]["artifacts"] != artifacts],
        ),
        Claim(
            "no published result was made again",
            [
                seen.job["id"]
                for seen in clients.seen
                if seen.job["id"] in published and len(_starts(seen)) != starts_before[seen.job["id"]]
            ],
        ),
        Claim(
            "every job with a checkpoint resumed from it",
            [name for name, starts in again.items() if not starts or starts[0]["from"] == 0],
        ),
        *claims_about_jobs(clients),
    ]


def _starts(seen: Seen) -> list[dict[str, Any]]:
    journal = Path(seen.plan["journal"])
    return [json.loads(line) for line in journal.read_text().splitlines()] if journal.exists() else []


def main() -> int:
    parser = argparse.ArgumentParser(description="A backup under load, restored elsewhere.")
    parser.add_argument("--jobs", type=int, default=60)
    parser.add_argument("--workers", type=int, default=3)
    given = parser.parse_args()
    folder = new_folder()
    try:
        claims = asyncio.run(rehearse(folder, given.jobs, given.workers))
    finally:
        shutil.rmtree(folder, ignore_errors=True)
    for claim in claims:
        print(f"{'BROKEN' if claim.broken else 'held'}: {claim.name} {' '.join(claim.broken)}")
    return int(any(claim.broken for claim in claims))


if __name__ == "__main__":
    sys.exit(main())
