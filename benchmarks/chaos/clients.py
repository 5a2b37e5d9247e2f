"""Clients as careful users write them: they repeat each call, on any replica, until it is answered."""

from __future__ import annotations

import asyncio
import contextlib
import hashlib
import io
import json
import math
import random
import time
import uuid
import zipfile
from collections import Counter
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Literal

import httpx

Kind = Literal["good", "refused", "poisoned", "cancelled"]
FINAL = {"succeeded", "failed", "cancelled"}
ANSWER_S = 8.0
LONG_POLL_S = 4.0
PARTS = 3  # of the jobs that split themselves
RESULT = {"log.txt", "renders/one.png", "report.json"}
TUS = {"Tus-Resumable": "1.0.0"}


@dataclass
class Seen:
    """One job as its client saw it."""

    kind: Kind
    plan: dict[str, Any]
    job: dict[str, Any] = field(default_factory=dict)
    state_at_cancel: str | None = None
    events: list[dict[str, Any]] = field(default_factory=list)
    faults: list[str] = field(default_factory=list)

    def expected(self) -> set[str]:
        """The correct final states."""
        if self.kind == "cancelled":
            if self.state_at_cancel in FINAL:
                return {str(self.state_at_cancel)}
            return {"cancelled"}
        return {"good": {"succeeded"}, "refused": {"failed"}, "poisoned": {"failed"}}[self.kind]


class Clients:
    """Submit, follow and check ``count`` jobs, ``at_once`` at a time."""

    def __init__(self, ports: list[int], folder: Path, chance: random.Random) -> None:
        self._urls = [f"http://127.0.0.1:{port}" for port in ports]
        self.folder, self.chance = folder, chance
        self.answers: Counter[int | str] = Counter()
        self.seen: list[Seen] = []
        self._http = httpx.AsyncClient(timeout=ANSWER_S)

    async def prepare(self) -> None:
        """Set up, before the first fault."""

    async def run(self, count: int, at_once: int, within_s: float = math.inf) -> None:
        """Run until all jobs are final and checked; submits none after ``within_s``."""
        turn, end = asyncio.Semaphore(at_once), time.monotonic() + within_s

        async def one(seen: Seen) -> None:
            async with turn:
                if time.monotonic() < end:
                    self.seen.append(seen)
                    await self.submit_and_follow(seen)

        await asyncio.gather(*(one(self.planned(n)) for n in range(count)))
        await self._http.aclose()

    def planned(self, n: int) -> Seen:
        kinds: list[Kind] = ["good"] * 6 + ["cancelled"] * 3 + ["refused"]
        kind: Kind = "poisoned" if n % 40 == 7 else kinds[n % 10]
        plan = {
            "steps": self.chance.randint(8, 40),
            "step_s": 0.05,
            "seed": f"{n}",
            "journal": str(self.folder / f"journal-{n}"),
            **({"refuse": True} if kind == "refused" else {}),
            **({"die_at": 3} if kind == "poisoned" else {}),
            **({"parts": PARTS} if n % 3 == 0 else {}),
        }
        return Seen(kind, plan)

    async def submit_and_follow(self, seen: Seen) -> None:
        """Submit a job and follow it to its result."""
        await self.submit(seen)
        await self.see_through(seen)

    async def see_through(self, seen: Seen) -> None:
        """Follow a queued job to its result."""
        live = asyncio.create_task(self._follow(seen.job["id"]))
        if seen.kind == "cancelled":
            await asyncio.sleep(self.chance.uniform(0, 4.0))
            seen.state_at_cancel = (await self.json("POST", f"/v1/jobs/{seen.job['id']}/cancel"))["state"]
        while seen.job["state"] not in FINAL:
            seen.job = await self.json("GET", f"/v1/jobs/{seen.job['id']}?wait={LONG_POLL_S:g}")
        seen.events = await self._follow(seen.job["id"])
        if await live != seen.events:
            seen.faults.append("who followed live saw another history than who came later")
        await self.look_through(seen)

    async def submit(self, seen: Seen) -> None:
        """Create the dataset and submit the job."""
        dataset = (await self.json("POST", "/v1/datasets", json={"name": "chaos"}))["id"]
        content = json.dumps(seen.plan).encode()
        if self.chance.random() < 0.5:
            await self._send_archive(dataset, {"plan.json": content})
        else:
            await self.json("PUT", f"/v1/datasets/{dataset}/files/plan.json", content=content)
        await self.json("POST", f"/v1/datasets/{dataset}/finalize")
        seen.job = await self.json(
            "POST",
            "/v1/jobs",
            json={"dataset_id": dataset, "options": {"preset": "fast"}},
            headers={"Idempotency-Key": uuid.uuid4().hex},
        )

    async def _send_archive(self, dataset: str, files: dict[str, bytes]) -> None:
        """Send files by a resumable upload, which some process unpacks once it is complete."""
        packed = io.BytesIO()
        with zipfile.ZipFile(packed, "w") as archive:
            for name, content in files.items():
                archive.writestr(name, content)
        whole, length = packed.getvalue(), {**TUS, "Upload-Length": str(packed.tell())}
        upload = (await self.json("POST", f"/v1/datasets/{dataset}/uploads", headers=length))["id"]
        at = 0
        while at < len(whole):
            offset = {**TUS, "Upload-Offset": str(at), "Content-Type": "application/offset+octet-stream"}
            await self.call("PATCH", f"/v1/uploads/{upload}", headers=offset, content=whole[at:])
            there = await self.call("HEAD", f"/v1/uploads/{upload}", headers=TUS)
            at = int(there.headers["upload-offset"])

    async def json(self, method: str, path: str, **request: Any) -> dict[str, Any]:
        answer = await self.call(method, path, **request)
        if answer.status_code >= 300:
            raise RuntimeError(f"{method} {path}: {answer.status_code} {answer.text}")
        # The response to a file that is sent again, after the first one was lost, is empty.
        found: dict[str, Any] = answer.json() if answer.content else {}
        return found

    async def call(self, method: str, path: str, **request: Any) -> httpx.Response:
        """Repeat a request until its answer is not 'try again'."""
        while True:
            url = self.chance.choice(self._urls)
            try:
                answer = await self._http.request(method, url + path, **request)
            except httpx.TransportError as error:
                self.answers[type(error).__name__] += 1
            else:
                self.answers[answer.status_code] += 1
                if answer.status_code < 500:
                    return answer
            await asyncio.sleep(self.chance.uniform(0.1, 0.5))

    async def _follow(self, job_id: str) -> list[dict[str, Any]]:
        """The whole history by server-sent events, resumed where the stream broke."""
        events: list[dict[str, Any]] = []
        while not any(event["type"] in FINAL for event in events):
            headers = {"Last-Event-ID": str(events[-1]["seq"])} if events else {}
            url = f"{self.chance.choice(self._urls)}/v1/jobs/{job_id}/events"
            with contextlib.suppress(httpx.TransportError):
                async with self._http.stream("GET", url, headers=headers) as answer:
                    await _collect(answer, events)
            await asyncio.sleep(0.1)
        return events

    async def look_through(self, seen: Seen) -> None:
        path = f"/v1/jobs/{seen.job['id']}/artifacts"
        listed = (await self.json("GET", path))["items"]
        for item in listed:
            answer = await self.call("GET", f"{path}/{item['name']}")
            if hashlib.sha256(answer.content).hexdigest() != item["sha256"]:
                seen.faults.append(f"{item['name']} has other bytes than its digest says")
            if item["name"] == "report.json" and seen.job["state"] == "succeeded":
                said = answer.json()
                if said["chain"] != chain(seen.plan["seed"], seen.plan["steps"]):
                    seen.faults.append(f"the result is wrong: {said}")
                if {name: files for name, files in said["joined"].items() if files != ["report.json"]}:
                    seen.faults.append(f"parts were lost: {said['joined']}")
                if len(said["joined"]) != seen.plan.get("parts", 0):
                    seen.faults.append(f"other parts were joined: {said['joined']}")
            if item["name"] == "renders/one.png" and answer.content != b"\x89PNG counted":
                seen.faults.append("the render is wrong")
        names = sorted(item["name"] for item in listed)
        if seen.job["state"] == "succeeded" and names != sorted(RESULT):
            seen.faults.append(f"the result is not whole: {names}")


def chain(seed: str, steps: int) -> str:
    """The counting program's result, which must not depend on the number of attempts."""
    for step in range(1, steps + 1):
        seed = hashlib.sha256(f"{seed}{step}".encode()).hexdigest()
    return seed


async def _collect(answer: httpx.Response, events: list[dict[str, Any]]) -> None:
    if answer.status_code != 200:
        return
    numbered, began = False, time.monotonic()
    async for line in answer.aiter_lines():
        if line.startswith("id:"):
            numbered = True
        elif line.startswith("data:") and numbered:
            events.append(json.loads(line[5:]))
            numbered = False
        if time.monotonic() - began > 60:
            return
