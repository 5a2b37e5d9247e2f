"""Poses for a folder of images that has none: COLMAP, run in a child process."""

from __future__ import annotations

import hashlib
import importlib.util
import json
import tempfile
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from biresnerf.data.atomic_file import whole_file
from biresnerf.data.colmap_process import run_colmap
from biresnerf.data.dataset import Camera, Dataset
from biresnerf.data.transforms_json import MIN_IMAGES, few_names
from biresnerf.errors import InputError
from biresnerf.geometry.lens import lens_problem

ALL_PAIRS_UP_TO = 150  # images; beyond it, neighbours in the order of names are matched (11 000 pairs at 150)
_OVERLAP_MEND = (
    "Take sharp photos that overlap by more than half, of something with texture, from many places; "
    "or give a transforms.json with approximate poses."
)


def seed_poses(
    dataset: Dataset,
    *,
    should_stop: Callable[[], bool] | None = None,
    seed: int = 0,
    limit_s: float = 3600.0,
    remember: Path | None = None,
    on_start: Callable[[], None] | None = None,
) -> Dataset:
    """The images that COLMAP can place, with its poses and one shared camera (one each where sizes differ).

    The frame and scale are COLMAP's own choice. Images it could not place are left out and named in the warnings.

    COLMAP's threads make its answer differ a little from run to run. A run that is to be continued keeps it
    in the file ``remember`` and is given the same poses again. ``on_start`` is called only if COLMAP does run.

    Args:
        dataset: images alone: frames without pose.
        should_stop: asked while COLMAP runs.
        seed: of COLMAP's random choices.
        limit_s: seconds that COLMAP may take.

    Raises:
        InputError: ``colmap_missing``, ``seed_failed`` or ``seed_timeout``.
        Interrupted: ``should_stop`` said so.
        RefinementError: ``seeding_crashed``: COLMAP itself failed.
    """
    if importlib.util.find_spec("pycolmap") is None:
        raise InputError(
            "colmap_missing",
            "there is no transforms.json, and finding poses needs COLMAP, which is not installed.",
            where=dataset.root.name,
            mend="Run `pip install 'biresnerf[colmap]'`, or give a transforms.json.",
        )
    key = _fingerprint(dataset, seed) if remember is not None else ""
    known = _remembered(remember, key)
    if known is not None:
        return _with_poses(dataset, known)
    if on_start is not None:
        on_start()
    with tempfile.TemporaryDirectory(prefix="biresnerf-colmap-") as work:
        request = {
            "task": "from_scratch",
            "root": str(dataset.root),
            "names": list(dataset.names),
            "work": work,
            "answer": str(Path(work, "answer.json")),
            "camera_per_image": len({(c.width, c.height) for c in dataset.cameras}) > 1,
            "sequential": len(dataset) > ALL_PAIRS_UP_TO,
            "seed": seed,
        }
        answer = run_colmap(request, Path(work), should_stop or (lambda: False), limit_s)
    seeded = _with_poses(dataset, answer)
    if remember is not None:
        with whole_file(remember) as temporary:
            temporary.write_text(json.dumps({"key": key, "answer": answer}), "utf-8")
    return seeded


def _fingerprint(dataset: Dataset, seed: int) -> str:
    """Of everything that COLMAP's answer depends on."""
    digest = hashlib.sha256(json.dumps([dataset.names, seed]).encode())
    for frame in dataset.frames:
        with frame.path.open("rb") as file:
            digest.update(hashlib.file_digest(file, "sha256").digest())
    return digest.hexdigest()


def _remembered(remember: Path | None, key: str) -> dict[str, Any] | None:
    """The answer kept for the same images, if there is one; our own file, written whole."""
    if remember is None or not remember.is_file():
        return None
    kept = json.loads(remember.read_text("utf-8"))
    return kept["answer"] if kept["key"] == key else None


def _with_poses(dataset: Dataset, answer: dict[str, Any]) -> Dataset:
    placed = {image["name"]: image for image in answer["images"]}
    missing = [name for name in dataset.names if name not in placed]
    if len(placed) < MIN_IMAGES:
        raise InputError(
            "seed_failed",
            f"COLMAP could place {len(placed)} of {len(dataset)} images; at least {MIN_IMAGES} are needed.",
            where=dataset.root.name,
            mend=_OVERLAP_MEND,
        )
    cameras: dict[Camera, int] = {}
    frames = []
    for frame in dataset.frames:
        if frame.name not in placed:
            continue
        described = answer["cameras"][placed[frame.name]["camera"]]
        camera = Camera(
            described["model"], described["width"], described["height"], tuple(described["params"])
        )
        cam_from_world = np.vstack([placed[frame.name]["cam_from_world"], [0.0, 0.0, 0.0, 1.0]])
        index = cameras.setdefault(camera, len(cameras))
        frames.append(
            replace(frame, camera=index, world_from_cam=_inverse(cam_from_world), pose_source="colmap")
        )
    _refuse_implausible(cameras, dataset.root)
    notes = list(dataset.warnings)
    if missing:
        notes.append(
            f"COLMAP could not place {len(missing)} of {len(dataset)} images, which are left out: "
            f"{few_names(missing, 20)}"
        )
    return replace(
        dataset,
        cameras=tuple(cameras),
        frames=tuple(frames),
        warnings=tuple(notes),
        intrinsics_sources=tuple("colmap" for _ in cameras),
    )


def _inverse(rigid: np.ndarray) -> np.ndarray:
    inverse = np.eye(4)
    inverse[:3, :3] = rigid[:3, :3].T
    inverse[:3, 3] = -rigid[:3, :3].T @ rigid[:3, 3]
    return inverse


def _refuse_implausible(cameras: dict[Camera, int], root: Path) -> None:
    """An impossible lens is what COLMAP finds where the views fix too little."""
    for camera in cameras:
        if lens_problem(camera.full(), camera.width, camera.height) is not None:
            raise InputError(
                "seed_failed",
                "COLMAP found an impossible lens, so its poses mean nothing.",
                where=root.name,
                mend=_OVERLAP_MEND,
            )
