"""COLMAP's answer for a set, kept so that a resumed run gets the same poses again."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

from biresnerf.data.model.atomic_file import write_text
from biresnerf.data.model.dataset import Dataset
from biresnerf.data.seeding.map_images import AskMatches, Mapping, ask_colmap, read_mapping
from biresnerf.data.seeding.seeding_progress import OnSeeding, SeedingProgress
from biresnerf.options.refine_options import SeedingEffort
from biresnerf.uncertainty import PartsReport

GUIDED_LIMIT_S, LIMIT_S = 900.0, 3600.0  # where all poses are given, and else
MANY = 150  # photos; more have longer


def remembered_mapping(
    dataset: Dataset,
    should_stop: Callable[[], bool],
    seed: int,
    effort: SeedingEffort,
    remember: Path | None,
    on_progress: OnSeeding,
    ask: AskMatches | None = None,
) -> Mapping:
    """What COLMAP (or ``ask``) finds, or found earlier for the same request if the file ``remember`` kept it.

    An answer found with more effort than is now requested is as good.

    Raises:
        InputError: ``seed_timeout``.
        Interrupted: ``should_stop`` returned true.
        RefinementError: ``seeding_crashed``.
    """
    key = _fingerprint(dataset, seed) if remember is not None else ""
    keys = {"full": (key,), "low": (f"{key} low", key)}[effort]
    answer = _remembered(remember, keys)
    if answer is None:
        on_progress(SeedingProgress())
        limit_s = GUIDED_LIMIT_S if dataset.posed.all() else LIMIT_S
        limit_s *= max(1.0, len(dataset) / MANY)
        kept = None if remember is None else remember.with_name(f"features-{keys[0][:16]}.db")
        answer = (ask or ask_colmap)(
            dataset,
            should_stop=should_stop,
            seed=seed,
            effort=effort,
            limit_s=limit_s,
            log_folder=remember.parent if remember is not None else None,
            kept=kept,
            on_progress=on_progress,
        )
        if remember is not None and kept is not None:
            write_text(remember, json.dumps({"key": keys[0], "answer": answer}))
            kept.unlink(missing_ok=True)
    return read_mapping(dataset, answer)


def joined_parts(remembered: Path) -> PartsReport | None:
    """How well the parts agree that an answer was joined from; None of COLMAP's own, or where there is none."""
    if not remembered.is_file():
        return None
    parts = json.loads(remembered.read_text("utf-8"))["answer"].get("parts")
    return None if parts is None else PartsReport.model_validate(parts)


def _fingerprint(dataset: Dataset, seed: int) -> str:
    """A digest of everything that COLMAP's answer depends on."""
    given = [None if f.world_from_cam is None else f.world_from_cam.tolist() for f in dataset.frames]
    cameras = [[c.model, c.params] for c in dataset.cameras]
    digest = hashlib.sha256(json.dumps([dataset.names, seed, given, cameras]).encode())
    for frame in dataset.frames:
        with frame.path.open("rb") as file:
            digest.update(hashlib.file_digest(file, "sha256").digest())
    return digest.hexdigest()


def _remembered(remember: Path | None, keys: tuple[str, ...]) -> dict[str, Any] | None:
    """The answer kept for the same images, if there is one; our own file, written whole."""
    if remember is None or not remember.is_file():
        return None
    kept = json.loads(remember.read_text("utf-8"))
    return kept["answer"] if kept["key"] in keys else None
