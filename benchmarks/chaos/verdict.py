"""The claims that must hold after the storm."""

from __future__ import annotations

import asyncio
import json
import time
from collections import Counter
from dataclasses import dataclass
from pathlib import Path

from benchmarks.chaos.clients import FINAL, Clients, Seen
from benchmarks.chaos.installation import Installation
from workers.database.database import Database
from workers.records import shown_key

# A start that was under way when the job ended may still be reported.
START_S = 5.0
STORES_OWN = {"health", "store-id"}


@dataclass(frozen=True)
class Claim:
    """One thing that must hold; ``broken`` lists where it does not."""

    name: str
    broken: list[str]


def claims_about_jobs(clients: Clients) -> list[Claim]:
    """Claims about what the clients saw."""
    wrong = [
        f"{seen.job['id']} ({seen.kind}, {seen.state_at_cancel} at its cancel) is {seen.job['state']}:"
        f" {seen.job.get('error')}"
        for seen in clients.seen
        if seen.job["state"] not in seen.expected()
    ]
    return [
        Claim("every job is in the right state", wrong),
        Claim("every history is gapless, with one end", _each(clients.seen, _history)),
        Claim("every result is published once, whole, with the right bytes", _each(clients.seen, _result)),
        Claim("nothing starts after its cancel", _each(clients.seen, _late_starts)),
        Claim(
            "no answer is an internal error",
            [f"{count} times {status}" for status, count in clients.answers.items() if status in (500, 502)],
        ),
    ]


def _each(seen: list[Seen], look) -> list[str]:
    return [f"{one.job['id']}: {text}" for one in seen for text in look(one)]


def _history(seen: Seen) -> list[str]:
    types = [event["type"] for event in seen.events]
    broken = []
    if [event["seq"] for event in seen.events] != list(range(1, len(types) + 1)):
        broken.append(f"the history has gaps: {[event['seq'] for event in seen.events]}")
    if [kind for kind in types if kind in FINAL] != [seen.job["state"]] or types[-1] != seen.job["state"]:
        broken.append(f"the history does not end as the job did: {types}")
    return broken


def _result(seen: Seen) -> list[str]:
    published = [event for event in seen.events if event["type"] == "succeeded"]
    if len(published) != (seen.job["state"] == "succeeded"):
        return [*seen.faults, f"published {len(published)} times"]
    return seen.faults


def _late_starts(seen: Seen) -> list[str]:
    types = [event["type"] for event in seen.events]
    asked = [n for n, kind in enumerate(types) if kind in ("cancel_requested", "cancelled")]
    if not asked:
        return []
    broken = ["claimed after its cancel"] if "started" in types[asked[0] :] else []
    ended = time.mktime(time.strptime(seen.job["finished_at"][:19], "%Y-%m-%dT%H:%M:%S")) - time.timezone
    journal = Path(seen.plan["journal"])
    starts = [json.loads(line)["at"] for line in journal.read_text().splitlines()] if journal.exists() else []
    return broken + [f"started {at - ended:.1f} s after its end" for at in starts if at > ended + START_S]


async def claims_about_rest(installation: Installation, database: Database, patience_s: float) -> list[Claim]:
    """Claims about what is left in tables, store and folders, once the janitor has had time to clean up."""
    end = time.monotonic() + patience_s
    while True:
        claims = [
            Claim("the queue is empty", await _queue(database)),
            Claim(
                "the store holds what is referred to and nothing else", await _store(installation, database)
            ),
            Claim("nothing is left in scratch and staging", _scratch(installation)),
        ]
        if not any(claim.broken for claim in claims) or time.monotonic() > end:
            return claims
        await asyncio.sleep(0.5)


async def _queue(database: Database) -> list[str]:
    rows = await database.fetch(
        "SELECT state AS what, count(*) AS n FROM queue_entries WHERE state IN ('todo', 'doing')"
        " GROUP BY state UNION ALL SELECT state, count(*) FROM jobs WHERE state IN ('queued', 'running')"
        " GROUP BY state UNION ALL SELECT 'trash', count(*) FROM trash HAVING count(*) > 0"
    )
    return [f"{row['n']} {row['what']}" for row in rows]


async def _store(installation: Installation, database: Database) -> list[str]:
    there = await asyncio.to_thread(installation.stored_keys) - STORES_OWN
    rows = await database.fetch("SELECT key FROM dataset_files UNION SELECT key FROM job_file_keys")
    known = {row["key"] for row in rows}
    checked = await database.fetch("SELECT id FROM datasets WHERE state = 'ready'")
    # What pages show of a checked set: all of its files or none.
    shown = tuple(f"{shown_key(row['id'])}/" for row in checked)
    lost = [f"lost: {key}" for key in sorted(known - there)]
    return lost + [f"nobody's: {key}" for key in sorted(there - known) if not key.startswith(shown)]


def _scratch(installation: Installation) -> list[str]:
    data = installation.settings.data_dir
    found = [path for folder in (data / "scratch", data / "staging") for path in folder.rglob("*")]
    return [str(path.relative_to(data)) for path in found if path.is_file()]


def told(claims: list[Claim], faults: Counter[str], answers: Counter[int | str], seconds: float) -> str:
    """The verdict as text."""
    lines = [f"{sum(faults.values())} faults in {seconds:.0f} s: {dict(sorted(faults.items()))}"]
    lines.append(f"answers: {dict(sorted(answers.items(), key=str))}")
    for claim in claims:
        lines.append(f"{'BROKEN' if claim.broken else 'held'}: {claim.name}")
        lines += [f"    {text}" for text in claim.broken[:20]]
    return "\n".join(lines)
