"""The world as the database shows it, and the states that must never be visible in it."""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping
from typing import Any

import psycopg
from psycopg.rows import dict_row

from tests.workers.queue.promises.model import ENDS, Job, Place

_JOBS = """
    SELECT jobs.*, entry.status::text AS entry, entry.worker_id,
        entry.scheduled_at > now() AS waits, entry.abort_requested,
        ARRAY(SELECT type FROM job_events WHERE job_id = jobs.id ORDER BY seq) AS events,
        ARRAY(SELECT seq FROM job_events WHERE job_id = jobs.id ORDER BY seq) AS numbers,
        ARRAY(SELECT prefix FROM trash WHERE starts_with(prefix, 'jobs/' || jobs.id || '/')) AS trash,
        ARRAY(SELECT keep FROM trash WHERE prefix = 'jobs/' || jobs.id || '/results') AS kept,
        ARRAY(SELECT keep FROM trash WHERE prefix = 'jobs/' || jobs.id || '/stages/coarse') AS kept_work,
        (SELECT count(*) FROM queue_entries AS live WHERE live.job_id = jobs.id
            AND live.state IN ('todo', 'doing')) AS live_entries
    FROM jobs JOIN procrastinate_jobs AS entry ON entry.id = jobs.queue_id ORDER BY jobs.queue_id"""
_COUNTED = """
    SELECT label, sum(amount)::int AS n FROM (
        SELECT label, amount FROM tally_log WHERE name = 'job_events'
        UNION ALL SELECT label, amount FROM tallies WHERE name = 'job_events') AS counts GROUP BY label"""


def observe(connection: psycopg.Connection) -> tuple[dict[str, Job], list[dict[str, Any]]]:
    """Jobs by the name that their client gave them; and the rows, for `broken_promises`."""
    with connection.cursor(row_factory=dict_row) as cursor:
        rows = cursor.execute(_JOBS).fetchall()
    return {row["idempotency_key"]: _job(row) for row in rows}, rows


def _job(row: Mapping[str, Any]) -> Job:
    place: Place = "over"
    if row["entry"] == "doing":
        place = "doing"
    elif row["entry"] == "todo":
        place = "later" if row["waits"] else "todo"
    root = f"jobs/{row['id']}/"
    same = ("state", "attempt", "crashes", "losses", "setback", "cancel_requested", "stage", "held")
    return Job(
        **{name: row[name] for name in same},
        late=row["start_by"] is not None,
        token=row["run_token"],
        checkpoint=None if row["checkpoint"] is None else row["checkpoint"]["prefix"].removeprefix(root),
        stage_work=_stage_work(row),
        result=tuple(item["key"].removeprefix(root) for item in row["artifacts"]),
        place=place,
        worker=row["worker_id"] if place == "doing" else None,
        abort=row["abort_requested"] and place == "doing",
        events=tuple(row["events"]),
        trash=frozenset(prefix.removeprefix(root) for prefix in row["trash"]),
    )


def _stage_work(row: Mapping[str, Any]) -> str | None:
    """The folder of the work of stage 1 that other jobs may start from."""
    recorded = row["reusable"].get("coarse")
    return None if recorded is None else recorded["prefix"].removeprefix(f"jobs/{row['id']}/")


def broken_promises(
    connection: psycopg.Connection,
    rows: list[dict[str, Any]],
    accepted: set[str],
    confirmed: Mapping[str, int],
    late: Mapping[str, int],
) -> list[str]:
    """What of the promises does not hold, read from the rows alone.

    Args:
        accepted: names of the jobs whose submission was answered.
        confirmed: names of jobs whose cancellation was answered while they were not over, and how many events
            their history had then.
        late: likewise of jobs whose deadline has passed.
    """
    broken = [f"{name} is lost" for name in accepted - {row["idempotency_key"] for row in rows}]
    for row in rows:
        name, events = row["idempotency_key"], row["events"]
        after = events[confirmed.get(name, len(events)) :]
        ends = [event for event in events if event in ENDS]
        final, work = row["state"] in ENDS, _stage_work(row)
        holds = {
            "has a gap in its history": row["numbers"] == list(range(1, row["seq"] + 1)),
            "has more or less than one end": len(ends) == final,
            "goes on after its end": not ends or events[-1] == row["state"],
            "is unfinished and not in the queue once": final or row["live_entries"] == 1,
            "started or succeeded after its cancellation": not {"started", "succeeded"} & set(after),
            "started after its deadline": "started" not in events[late.get(name, len(events)) :],
            "shows a result without having succeeded": not row["artifacts"] or row["state"] == "succeeded",
            "shows files of two attempts": len({item["key"].split("/")[3] for item in row["artifacts"]}) <= 1,
            "has a result that is to be deleted": not row["artifacts"]
            or row["kept"] == [row["artifacts"][0]["key"].split("/")[3]],
            "counts more attempts than it started": row["attempt"] <= events.count("started"),
            "has lost the work of a stage, or keeps another's": not final
            or row["state"] == "expired"  # without any
            or row["kept_work"] == [work and work.rpartition("/")[2]],
            "has a checkpoint that is to be deleted": final
            or row["checkpoint"] is None
            or row["checkpoint"]["prefix"] not in row["trash"],
        }
        broken += [f"{name} {what}: {events}" for what, so in holds.items() if not so]
    counted = {row[0]: row[1] for row in connection.execute(_COUNTED)}
    happened = Counter(event for row in rows for event in row["events"])
    if counted != dict(happened):
        broken.append(f"the metrics count {counted}, the histories {dict(happened)}")
    return broken
