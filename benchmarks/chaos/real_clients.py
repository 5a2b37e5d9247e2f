"""Clients whose jobs are real refinements, as small as they can be."""

from __future__ import annotations

import asyncio
import hashlib
import json
import math
import subprocess
import sys
import uuid
from typing import Any

from benchmarks.chaos.clients import FINAL, Clients, Kind, Seen

VIEWS, SIZE = 6, 32
DATASETS = 20
# Files that are written last, or hold results.
RESULT = {"log.txt", "poses.json", "report.json", "transforms.json", "scene.glb", "tum.txt", "view.json"}
OPTIONS = {
    "preset": "fast",
    "device": "cpu",
    "threads": 1,
    "start": "given",
    "steps": 20,
    "max_image_size": 24,
    "samples_per_step": 1024,
    "pose_resolution_max": 16,
    "reconstruction_levels": 1,
    "reconstruction_resolution_max": 128,
    "table_size_log2": 10,
    "holdout": 0,
    "trial_steps": 0,
    "orbit_frames": 0,
    "shown_views": 0,
    "verdict": False,
    "checkpoint_every_s": 1,
}


class RealClients(Clients):
    """Refine a rendered scene again and again."""

    async def prepare(self) -> None:
        scene = self.folder / "scene"
        command = [sys.executable, "-m", "biresnerf.command_line", "make-scene", str(scene)]
        size = ["--views", str(VIEWS), "--size", str(SIZE), "--noise", "0.05", "--seed", "1"]
        await asyncio.to_thread(subprocess.run, [*command, *size], check=True, stdout=subprocess.DEVNULL)
        self._files = {
            path.relative_to(scene).as_posix(): path for path in scene.rglob("*") if path.is_file()
        }
        self._datasets: dict[int, asyncio.Task[str]] = {}

    def planned(self, n: int) -> Seen:
        kinds: list[Kind] = ["good"] * 8 + ["cancelled"] * 2
        # Jobs that the clients know only from the service have no journal.
        return Seen(kinds[n % 10], {"journal": str(self.folder / "no-journal"), "dataset": n % DATASETS})

    async def submit(self, seen: Seen) -> None:
        number: int = seen.plan["dataset"]
        if number not in self._datasets:
            self._datasets[number] = asyncio.create_task(self._ready_dataset())
        body = {
            "dataset_id": await self._datasets[number],
            "options": {**OPTIONS, "seed": self.chance.randint(0, 9)},
        }
        key = {"Idempotency-Key": uuid.uuid4().hex}
        seen.job = await self.json("POST", "/v1/jobs", json=body, headers=key)

    async def _ready_dataset(self) -> str:
        dataset: str = (await self.json("POST", "/v1/datasets", json={"name": "storm"}))["id"]
        for name, path in self._files.items():
            await self.json("PUT", f"/v1/datasets/{dataset}/files/{name}", content=path.read_bytes())
        found = await self.json("POST", f"/v1/datasets/{dataset}/finalize")
        while found["state"] == "finalizing":
            await asyncio.sleep(0.3)
            found = await self.json("GET", f"/v1/datasets/{dataset}")
        if found["state"] != "ready":
            raise RuntimeError(f"a good dataset is {found['state']}: {found['error']}")
        return dataset

    async def look_through(self, seen: Seen) -> None:
        if seen.job["state"] not in FINAL:
            return
        path = f"/v1/jobs/{seen.job['id']}/artifacts"
        listed = (await self.json("GET", path))["items"]
        names = [item["name"] for item in listed]
        contents: dict[str, bytes] = {}
        for item in listed:
            content = contents[item["name"]] = (await self.call("GET", f"{path}/{item['name']}")).content
            if hashlib.sha256(content).hexdigest() != item["sha256"]:
                seen.faults.append(f"{item['name']} has other bytes than its digest says")
        if len(names) != len(set(names)):
            seen.faults.append(f"files are listed twice: {sorted(names)}")
        if seen.job["state"] == "succeeded":
            seen.faults += faults_of(contents)


def faults_of(contents: dict[str, bytes]) -> list[str]:
    """What is wrong with a result: missing files or steps, or invalid poses."""
    if not set(contents) >= RESULT:
        return [f"the result is not whole: {sorted(contents)}"]
    report: dict[str, Any] = json.loads(contents["report.json"])
    frames = json.loads(contents["transforms.json"])["frames"]
    numbers = [value for frame in frames for row in frame["transform_matrix"] for value in row]
    wrong = [] if len(frames) == VIEWS and all(map(math.isfinite, numbers)) else ["poses are missing"]
    return (
        wrong
        if report["steps_done"] == OPTIONS["steps"]
        else [*wrong, f"{report['steps_done']} steps were made"]
    )
