"""How long real jobs take to end once they are cancelled, in every stage: `python -m benchmarks.service.cancelling`.

Each job is cancelled as it reaches its stage, with a partial result asked for, and timed until it is over.
"""

from __future__ import annotations

import argparse
import asyncio
import json
import os
import shutil
import subprocess
import sys
import tempfile
import time
from collections.abc import AsyncIterator
from pathlib import Path

from biresnerf.data.synthetic.scene import write_synthetic_scene
from biresnerf.options.refine_options import RefineOptions
from workers.database.embedded_postgres import EmbeddedPostgres
from workers.database.migrate import migrate
from workers.engine import Stores, open_stores
from workers.records import JobUpdate
from workers.settings.settings import Settings

STAGES = ("loading", "preparing", "seeding", "coarse", "fine", "evaluating", "exporting")
OPTIONS = RefineOptions(
    preset="fast", steps=600, max_image_size=64, samples_per_step=8192, reconstruction_levels=4,
    table_size_log2=14, start="given", orbit_frames=24, trial_steps=200, exports=("pinhole",),
)  # fmt: skip


async def _bytes(path: Path) -> AsyncIterator[bytes]:
    yield path.read_bytes()


async def _dataset(stores: Stores, scene: Path, *, poses: bool) -> str:
    dataset = await stores.datasets.create("cancelling")
    for path in sorted(scene.rglob("*")):
        if path.is_file() and (poses or path.suffix == ".png"):
            await stores.datasets.add_file(dataset.id, path.relative_to(scene).as_posix(), _bytes(path))
    await stores.datasets.finalize(dataset.id)
    checked = await stores.datasets.check(dataset.id)
    if checked.state != "ready":
        raise SystemExit(f"the scene was rejected: {checked.error}")
    return checked.id


def _reached(update: JobUpdate, stage: str) -> bool:
    if stage == "loading":  # its files are copied, then Python, torch and the kernels are loaded
        return update.job.state == "running"
    return any(event.type == "stage" and event.data["stage"] == stage for event in update.events)


async def _cancelled(stores: Stores, dataset_id: str, stage: str) -> dict[str, object]:
    start = {"start": "colmap"} if stage == "seeding" else {}
    job, _ = await stores.jobs.submit(dataset_id, OPTIONS.model_copy(update=start))
    asked_at: float | None = None
    async for update in stores.jobs.subscribe(job.id):
        if update is None:
            continue
        if asked_at is None and _reached(update, stage):
            asked_at = time.monotonic()
            await stores.jobs.cancel(job.id, keep_partial=True)
        job = update.job
    over_at = time.monotonic()
    names = {item.name for item in await stores.jobs.artifacts(job.id)}
    return {
        "stage": stage,
        "state": job.state,
        "seconds": round(over_at - (asked_at or over_at), 2),
        "partial": job.partial,
        "poses": "poses.json" in names,
    }


async def measure(folder: Path, stages: list[str], views: int, size: int) -> list[dict[str, object]]:
    """A service of its own: database, one worker, and a job for each stage."""
    postgres = EmbeddedPostgres(folder / "postgres")
    url = postgres.start()
    try:
        migrate(url)
        settings = Settings(database_url=url, data_dir=folder / "data")
        scene = folder / "scene"
        write_synthetic_scene(scene, views, size, seed=1)
        variables = {"BIRESNERF_DATABASE_URL": url, "BIRESNERF_DATA_DIR": str(settings.data_dir)}
        with (folder / "slot.log").open("wb") as log:
            slot = subprocess.Popen(
                [sys.executable, "-m", "workers.queue.slot"],
                env={**os.environ, **variables},
                stdout=log,
                stderr=log,
            )
        try:
            rows = []
            async with open_stores(settings) as stores:
                posed = await _dataset(stores, scene, poses=True)
                bare = await _dataset(stores, scene, poses=False) if "seeding" in stages else ""
                for stage in stages:
                    rows.append(await _cancelled(stores, bare if stage == "seeding" else posed, stage))
                    sys.stdout.write(f"{rows[-1]}\n")
            return rows
        finally:
            slot.terminate()
            slot.wait()
    finally:
        postgres.stop()


def main() -> int:
    """Exit status 0 where every job ended, cancelled, within the limit."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--stages", nargs="*", default=list(STAGES), choices=STAGES)
    parser.add_argument("--views", type=int, default=24)
    parser.add_argument("--size", type=int, default=200)
    parser.add_argument("--limit-s", type=float, default=10.0)
    parser.add_argument("--output", type=Path, default=Path("cancelling.json"))
    asked = parser.parse_args()
    folder = Path(tempfile.mkdtemp(prefix="biresnerf-cancelling-"))
    folder.chmod(0o711)  # PostgreSQL's user must get through
    try:
        rows = asyncio.run(measure(folder, asked.stages, asked.views, asked.size))
    finally:
        shutil.rmtree(folder, ignore_errors=True)
    asked.output.write_text(json.dumps(rows, indent=1) + "\n")
    slow = [row for row in rows if row["state"] != "cancelled" or float(str(row["seconds"])) > asked.limit_s]
    return 1 if slow else 0


if __name__ == "__main__":
    sys.exit(main())
