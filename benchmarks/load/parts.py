"""The parts of the measurement. Each takes a running installation and returns its figures."""

from __future__ import annotations

import asyncio
import json
import os
import random
import time
from typing import Any

from psycopg.types.json import Jsonb

from benchmarks.load.calls import Calls, Process, at_once, spread
from biresnerf.options.refine_options import RefineOptions
from workers.database import job_queue
from workers.database.database import Database
from workers.engine import Stores

Figures = dict[str, Any]
OPTIONS = {"preset": "fast"}
PATIENCE_S = 120.0
QUIET_S = 5.0
ONE_MORE = """SELECT add_job_event(%s, 'stage', '{"stage": "coarse"}') AS seq"""


async def ready_dataset(calls: Calls) -> str:
    """A dataset that jobs can use."""
    dataset: str = (await calls("createDataset", "POST", "/v1/datasets", json={"name": "load"})).json()["id"]
    plan = json.dumps({"steps": 1, "step_s": 0.0, "journal": os.devnull})
    await calls("putFile", "PUT", f"/v1/datasets/{dataset}/files/plan.json", content=plan.encode())
    await calls("finalizeDataset", "POST", f"/v1/datasets/{dataset}/finalize")
    return dataset


async def fill(database: Database, dataset: str, count: int, first: int = 0) -> None:
    """Insert waiting jobs, numbers ``first`` to ``count``, into the tables; they are older than all others."""
    options = Jsonb({"preset": "fast"})
    for begin in range(first, count, 1000):
        async with database.transaction() as connection:
            for n in range(begin, min(count, begin + 1000)):
                job_id = f"job_0load{n:07}"
                entry_id = await job_queue.enqueue(connection, job_id, "refine", order=0, held=False)
                await connection.execute(
                    "INSERT INTO jobs (id, dataset_id, options, planned_steps, fingerprint, queue_id, created_at)"
                    " VALUES (%s, %s, %s, 3000, '', %s, now() - interval '1 day' + make_interval(secs => %s))",
                    (job_id, dataset, options, entry_id, n),
                )
    async with database.pool.connection() as connection:
        await connection.set_autocommit(True)
        await connection.execute("VACUUM ANALYZE")  # as autovacuum would after a while
        await connection.set_autocommit(False)


async def enqueue(calls: Calls, process: Process, stores: Stores, dataset: str, count: int) -> Figures:
    """Submit ``count`` jobs over HTTP and as many through the library."""
    body, options = {"dataset_id": dataset, "options": OPTIONS}, RefineOptions(preset="fast")
    cpu = process.cpu_s()
    http_s = await at_once(
        16, [lambda: calls("submitJob", "POST", "/v1/jobs", json=body) for _ in range(count)]
    )
    cpu = process.cpu_s() - cpu
    direct_s = await at_once(8, [lambda: stores.jobs.submit(dataset, options) for _ in range(count)])
    return {
        "over_http_per_s": round(count / http_s, 1),
        "by_the_library_per_s": round(count / direct_s, 1),
        "cpu_ms_of_the_api_each": round(1000 * cpu / count, 2),
    }


async def lists(calls: Calls, total: int) -> Figures:
    """Page through all jobs, by two filters, and read single jobs."""
    seen: list[str] = []
    for query, name in (("", "listJobs, 200 of all"), ("&state=queued", "listJobs, 200 of the queued")):
        cursor, found = "", []
        while cursor is not None:
            more = f"&cursor={cursor}" if cursor else ""
            page = (await calls(name, "GET", f"/v1/jobs?limit=200{query}{more}")).json()
            found += [item["id"] for item in page["items"]]
            cursor = page["next_cursor"]
        if len(found) != total or len(set(found)) != total:
            raise RuntimeError(f"{name}: {len(set(found))} of {total} jobs were listed")
        seen = found
    chance = random.Random(1)
    looks = [chance.choice(seen) for _ in range(500)]
    one_s = await at_once(4, [lambda job=job: calls("getJob", "GET", f"/v1/jobs/{job}") for job in looks])
    await at_once(4, [lambda: calls("listJobs, 50", "GET", "/v1/jobs") for _ in range(100)])
    places = [(await calls("getJob", "GET", f"/v1/jobs/{seen[n]}")).json()["queue_position"] for n in (0, -1)]
    if places != [total, 1]:
        raise RuntimeError(f"the places in the queue are {places}, not {[total, 1]}")
    return {"jobs": total, "single_looks_per_s": round(500 / one_s, 1)}


async def uploads(calls: Calls, process: Process, count: int, mib: int) -> Figures:
    """Upload ``count`` files at the same time, each into its own dataset."""
    made = [await calls("createDataset", "POST", "/v1/datasets", json={"name": "load"}) for _ in range(count)]
    content, before, highest = os.urandom(2**20 * mib), process.mib(), [process.mib()]

    async def watch() -> None:
        while True:
            highest.append(process.mib())
            await asyncio.sleep(0.1)

    watching = asyncio.create_task(watch())
    try:
        seconds = await at_once(
            count,
            [
                lambda url=answer.headers["location"]: calls(
                    f"putFile, {mib} MiB, {count} at once", "PUT", f"{url}/files/a.bin", content=content
                )
                for answer in made
            ],
        )
    finally:
        watching.cancel()
    return {
        "uploads": count,
        "mib_each": mib,
        "mib_per_s": round(count * mib / seconds, 1),
        "memory_before_mib": before,
        "memory_highest_mib": max(highest),
    }


async def listeners(
    calls: Calls, process: Process, database: Database, jobs: list[str], count: int, seconds: float
) -> Figures:
    """``count`` event streams, spread over ``jobs``, each of which changes once a second."""
    heard: list[tuple[str, int, float]] = []
    opened: set[int] = set()
    refused = 0

    async def listen(n: int, job: str) -> None:
        nonlocal refused
        while not await listened(n, job):  # as the 503's Retry-After requests
            refused += 1
            await asyncio.sleep(1.0)

    async def listened(n: int, job: str) -> bool:
        async with calls.http.stream("GET", f"/v1/jobs/{job}/events") as answer:
            number: int | None = None
            if answer.status_code != 200:
                return False
            async for line in answer.aiter_lines():
                opened.add(n)
                if line.startswith("id:"):
                    number = int(line[3:])
                elif line.startswith("data:") and number is not None:
                    heard.append((job, number, time.perf_counter()))
                    number = None
        return True

    following = [asyncio.create_task(listen(n, jobs[n % len(jobs)])) for n in range(count)]
    began = time.perf_counter()
    while len(opened) < count and time.perf_counter() - began < PATIENCE_S:
        await asyncio.sleep(0.1)
    opened_s, memory = time.perf_counter() - began, process.mib()
    cpu = process.cpu_s()
    await asyncio.sleep(QUIET_S)
    idle_cores = (process.cpu_s() - cpu) / QUIET_S
    cpu, looking = process.cpu_s(), asyncio.create_task(_poll_jobs(calls, jobs))
    sent = await _change(database, jobs, seconds)
    due = sum(1 for n in range(count) for job, _ in sent if job == jobs[n % len(jobs)])
    began = time.perf_counter()
    while (told := sum((job, number) in sent for job, number, _ in heard)) < due:
        if time.perf_counter() - began > PATIENCE_S:
            break
        await asyncio.sleep(0.1)
    looking.cancel()
    busy_s = process.cpu_s() - cpu
    for task in following:
        task.cancel()
    await asyncio.gather(*following, return_exceptions=True)
    return {
        "listeners": len(opened),
        "jobs": len(jobs),
        "opened_in_s": round(opened_s, 1),
        "told_to_come_again": refused,
        "events_written": len(sent),
        "events_due": due,
        "events_heard": told,
        "delay": spread([at - sent[job, n] for job, n, at in heard if (job, n) in sent]),
        "memory_mib": memory,
        "cores_while_nothing_happens": round(idle_cores, 3),
        "cpu_ms_of_the_api_for_each_event_heard": round(1000 * busy_s / max(1, told), 3),
    }


async def _change(database: Database, jobs: list[str], seconds: float) -> dict[tuple[str, int], float]:
    """Change each job once a second; returns when each of its events was about to be written."""
    sent: dict[tuple[str, int], float] = {}
    began = time.perf_counter()
    while time.perf_counter() - began < seconds:
        for job in jobs:
            now = time.perf_counter()
            rows = await database.fetch(ONE_MORE, job)
            sent[job, rows[0]["seq"]] = now
            await asyncio.sleep(max(0.0, began + len(sent) / len(jobs) - time.perf_counter()))
    return sent


async def _poll_jobs(calls: Calls, jobs: list[str]) -> None:
    for n in range(10**6):
        await calls("getJob, beside the listeners", "GET", f"/v1/jobs/{jobs[n % len(jobs)]}")
        await asyncio.sleep(0.1)


async def an_hour(
    calls: Calls, process: Process, jobs: list[str], dataset: str, requests: int, seconds: float
) -> Figures:
    """A busy hour's requests of all kinds, as fast as possible or within `seconds`; measures memory meanwhile."""
    chance, memory = random.Random(2), [process.mib()]

    async def one() -> None:
        job = chance.choice(jobs)
        name, method, path, body = chance.choice(
            [
                ("getJob", "GET", f"/v1/jobs/{job}", None),
                ("getJob", "GET", f"/v1/jobs/{job}", None),
                ("listArtifacts", "GET", f"/v1/jobs/{job}/artifacts", None),
                ("listJobs, 50", "GET", "/v1/jobs", None),
                ("getDataset", "GET", f"/v1/datasets/{dataset}", None),
                ("listFiles", "GET", f"/v1/datasets/{dataset}/files", None),
                ("createDataset", "POST", "/v1/datasets", {"name": "load"}),
                ("cancelJob", "POST", f"/v1/jobs/{job}/cancel", None),
                ("readyz", "GET", "/readyz", None),
                ("putFile", "PUT", "", None),
            ]
        )
        if name == "putFile":
            made = await calls("createDataset", "POST", "/v1/datasets", json={"name": "load"})
            path = f"{made.headers['location']}/files/a.bin"
            await calls("putFile", "PUT", path, content=bytes(100_000))
            await calls("deleteDataset", "DELETE", made.headers["location"])
            return
        await calls(name, method, path, **({"json": body} if body else {}))

    pieces = 10 * max(1, round(seconds / 10))
    each = max(1, requests // pieces)
    began, cpu = time.perf_counter(), process.cpu_s()
    for done in range(1, pieces + 1):
        await at_once(8, [one for _ in range(each)])
        if done % (pieces // 10) == 0:
            memory.append(process.mib())
        await asyncio.sleep(max(0.0, began + done * seconds / pieces - time.perf_counter()))
    return {
        "requests": pieces * each,
        "per_s": round(pieces * each / (time.perf_counter() - began), 1),
        "cpu_ms_of_the_api_each": round(1000 * (process.cpu_s() - cpu) / (pieces * each), 2),
        "memory_mib": memory,
    }


async def dispatch(calls: Calls, dataset: str, count: int) -> Figures:
    """Time from submission to success of empty jobs, through all workers."""
    body = {"dataset_id": dataset, "options": OPTIONS}
    jobs = [(await calls("submitJob", "POST", "/v1/jobs", json=body)).json()["id"] for _ in range(count)]
    ends = [(await calls.http.get(f"/v1/jobs/{jobs[0]}?wait=60")).json()]
    began = time.perf_counter()
    for job in jobs[1:]:
        ends.append((await calls.http.get(f"/v1/jobs/{job}?wait=60")).json())
    seconds = time.perf_counter() - began
    states = {end["state"] for end in ends}
    if states != {"succeeded"}:
        raise RuntimeError(f"jobs that do nothing ended {states}")
    return {"jobs": count, "per_s": round((count - 1) / seconds, 2)}
