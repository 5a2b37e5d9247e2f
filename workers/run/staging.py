"""Fills the folder of a job's process: order, input, and the checkpoint to resume from."""

from __future__ import annotations

import json
import shutil
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from biresnerf.options.formats import formats
from biresnerf.uncertainty import NOT_REFINED, PartReport
from workers.database.database import Database
from workers.jobs.claim import Claim, parts_of, published_files
from workers.settings.settings import Settings
from workers.store.files import FileStore

EXPORTED_FROM = ("poses.json", "colmap/sparse/0/")  # of a result; all other formats can be made from these
JOINED_FROM = ("poses.json", "report.json", "colmap/sparse/0/")  # of the result of a part
JOINED_TO = ("poses.json", "report.json", "transforms.json")  # of a result whose poses stay
VIDEO_FRAMES = "video_frames/"  # of a result: photos that its dataset holds as a video
PANORAMA_VIEWS = "panorama_views/"  # of a result: what was cut from its dataset's panoramas


async def stage_job(
    database: Database, files: FileStore, settings: Settings, claim: Claim, folder: Path
) -> None:
    """Fill the fresh job folder. Paths in the order are relative, so that another machine can continue the job.

    Raises `NotFound` if a file is gone, `Unavailable`.
    """
    shutil.rmtree(folder, ignore_errors=True)
    for name in ("input", "output", "tmp"):
        (folder / name).mkdir(parents=True)
    options = {**claim.options, **claim.smaller}
    order: dict[str, Any] = {"input": "input", "output": "output", "options": options, "title": claim.title}
    if claim.kind == "export":
        order |= {"task": "export", "result": "result"}
        await _stage_result(files, await _parents_files(database, claim), EXPORTED_FROM, folder / "result")
    if claim.fixed_from is not None:
        order["result"] = "result"
        found = await published_files(database, claim.fixed_from)
        await _stage_result(files, found, JOINED_TO, folder / "result")
    if claim.kind == "refine" and claim.parent is None:
        if parts := await parts_of(database, claim.job_id):
            order["parts"] = "parts"
            await _stage_parts(files, parts, folder / "parts")
        elif claim.part_photos or settings.split_above:
            most = claim.part_photos or settings.part_photos
            order["split"] = {"above": claim.part_photos or settings.split_above, "most": most}
    if claim.kind == "refine" or _needs_photos(claim.options["formats"]):
        rows = await database.fetch(
            "SELECT key, path FROM dataset_files WHERE dataset_id = %s", claim.dataset_id
        )
        photos = ((row["key"], row["path"]) for row in rows)
        await files.stage(photos, folder / "input", to_read_only=True)
    if claim.kind == "export" and _needs_photos(claim.options["formats"]):
        found = await _parents_files(database, claim)
        for kind, place in ((VIDEO_FRAMES, "input"), (PANORAMA_VIEWS, "result")):
            await files.stage((pair for pair in found if pair[1].startswith(kind)), folder / place)
    await files.stage(_resumed_files(claim), folder / "output")
    (folder / "job.json").write_text(json.dumps(order, indent=1))


async def _stage_parts(files: FileStore, parts: list[dict[str, Any]], folder: Path) -> None:
    """The result of each part in a folder of its own, or why there is none."""
    width = max(2, len(str(len(parts))))
    for number, part in enumerate(parts, start=1):
        place = folder / f"part-{number:0{width}}"
        place.mkdir(parents=True)
        if part["state"] == "succeeded":
            found = [(item["key"], item["name"]) for item in part["artifacts"]]
            await files.stage((pair for pair in found if pair[1].startswith(JOINED_FROM)), place)
            continue
        why = (part["error"] or {}).get("detail") or f"its job ended as {part['state']}"
        report = PartReport(name=place.name, photos=len(part["options"]["photos"]), why_not=why)
        (place / NOT_REFINED).write_text(report.model_dump_json())


def _needs_photos(names: list[str]) -> bool:
    return any("photos" in formats()[name].needs for name in names)


def _resumed_files(claim: Claim) -> Iterator[tuple[str, str]]:
    """The files of the last checkpoint, or before the first, the stages' work to reuse."""
    if claim.checkpoint is not None:
        parts = [claim.checkpoint]
    else:
        # Of its own work a job reuses only the first stage: other devices cannot reuse the others, and with less memory
        # sizes differ.
        wanted = ["seeding"]
        if claim.forked_stage == "coarse" and not claim.smaller:
            wanted.append("coarse")
        parts = [claim.reusable[stage] for stage in wanted if stage in claim.reusable]
    for part in parts:
        for name in part["files"]:
            yield f"{part['prefix']}/{name}", name


async def _stage_result(
    files: FileStore, found: list[tuple[str, str]], names: tuple[str, ...], folder: Path
) -> None:
    folder.mkdir()
    await files.stage((pair for pair in found if pair[1].startswith(names)), folder)


async def _parents_files(database: Database, claim: Claim) -> list[tuple[str, str]]:
    assert claim.parent is not None, "an export has one"
    return await published_files(database, claim.parent)
