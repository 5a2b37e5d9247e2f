"""Poses for a folder of images that has none: COLMAP, run in a child process."""

from __future__ import annotations

import hashlib
import importlib.util
import json
import tempfile
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from biresnerf.data.atomic_file import whole_file
from biresnerf.data.colmap_process import run_colmap
from biresnerf.data.dataset import Camera, Dataset, Frame, SourceFormat
from biresnerf.data.image_files import ImageHeader, read_header
from biresnerf.data.transforms_json import MIN_IMAGES, few_names, orientation_notes, refuse_too_few
from biresnerf.errors import InputError
from biresnerf.geometry.lens import lens_problem

ALL_PAIRS_UP_TO = 150  # images; beyond it, neighbours in the order of names are matched (11 000 pairs at 150)
_OVERLAP_MEND = (
    "Take sharp photos that overlap by more than half, of something with texture, from many places; "
    "or give a transforms.json with approximate poses."
)


def seed_poses(
    root: Path,
    images: Sequence[Path],
    *,
    should_stop: Callable[[], bool] | None = None,
    seed: int = 0,
    limit_s: float = 3600.0,
    remember: Path | None = None,
    on_start: Callable[[], None] | None = None,
) -> Dataset:
    """The images that COLMAP can place, with its poses and one shared camera (one each where sizes differ).

    Names are paths relative to ``root``. The frame and scale are COLMAP's own choice. Images it could not
    place are left out and named in the warnings.

    COLMAP's threads make its answer differ a little from run to run. A run that is to be continued keeps it
    in the file ``remember`` and is given the same poses again. ``on_start`` is called only if COLMAP does run.

    Raises:
        InputError: ``too_few_images``, ``colmap_missing``, ``seed_failed``, ``seed_timeout``, or a code of
            `read_header`.
        Interrupted: ``should_stop`` said so.
        RefinementError: ``seeding_crashed``: COLMAP itself failed.
    """
    names = [path.relative_to(root).as_posix() for path in images]
    root = root.resolve()  # the name of "." is empty
    refuse_too_few(len(names), root.name)
    headers = {name: read_header(path, name) for name, path in zip(names, images, strict=True)}
    if importlib.util.find_spec("pycolmap") is None:
        raise InputError(
            "colmap_missing",
            "there is no transforms.json, and finding poses needs COLMAP, which is not installed.",
            where=root.name,
            mend="Run `pip install 'biresnerf[colmap]'`, or give a transforms.json.",
        )
    key = _fingerprint(images, names, seed) if remember is not None else ""
    known = _remembered(remember, key)
    if known is not None:
        return _dataset(root, headers, known)
    if on_start is not None:
        on_start()
    with tempfile.TemporaryDirectory(prefix="biresnerf-colmap-") as work:
        request = {
            "task": "from_scratch",
            "root": str(root),
            "names": names,
            "work": work,
            "answer": str(Path(work, "answer.json")),
            "camera_per_image": len({(h.width, h.height) for h in headers.values()}) > 1,
            "sequential": len(names) > ALL_PAIRS_UP_TO,
            "seed": seed,
        }
        answer = run_colmap(request, Path(work), should_stop or (lambda: False), limit_s)
    dataset = _dataset(root, headers, answer)
    if remember is not None:
        with whole_file(remember) as temporary:
            temporary.write_text(json.dumps({"key": key, "answer": answer}), "utf-8")
    return dataset


def _fingerprint(images: Sequence[Path], names: Sequence[str], seed: int) -> str:
    """Of everything that COLMAP's answer depends on."""
    digest = hashlib.sha256(json.dumps([names, seed]).encode())
    for path in images:
        with path.open("rb") as file:
            digest.update(hashlib.file_digest(file, "sha256").digest())
    return digest.hexdigest()


def _remembered(remember: Path | None, key: str) -> dict[str, Any] | None:
    """The answer kept for the same images, if there is one; our own file, written whole."""
    if remember is None or not remember.is_file():
        return None
    kept = json.loads(remember.read_text("utf-8"))
    return kept["answer"] if kept["key"] == key else None


def _dataset(root: Path, headers: dict[str, ImageHeader], answer: dict[str, Any]) -> Dataset:
    placed = {image["name"]: image for image in answer["images"]}
    missing = [name for name in headers if name not in placed]
    if len(placed) < MIN_IMAGES:
        raise InputError(
            "seed_failed",
            f"COLMAP could place {len(placed)} of {len(headers)} images; at least {MIN_IMAGES} are needed.",
            where=root.name,
            mend=_OVERLAP_MEND,
        )
    cameras: dict[Camera, int] = {}
    frames = []
    for name in headers:
        if name not in placed:
            continue
        described = answer["cameras"][placed[name]["camera"]]
        camera = Camera(
            described["model"], described["width"], described["height"], tuple(described["params"])
        )
        cam_from_world = np.vstack([placed[name]["cam_from_world"], [0.0, 0.0, 0.0, 1.0]])
        index = cameras.setdefault(camera, len(cameras))
        frames.append(Frame(name, root / name, index, _inverse(cam_from_world), "colmap"))
    _refuse_implausible(cameras, root)
    notes = orientation_notes(list(headers.values()), headers)
    if missing:
        notes.append(
            f"COLMAP could not place {len(missing)} of {len(headers)} images, which are left out: "
            f"{few_names(missing, 20)}"
        )
    source = SourceFormat("images", None, {}, np.eye(4))
    return Dataset(root, tuple(cameras), tuple(frames), source, tuple(notes))


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
