"""Runs COLMAP and the product on one set, by their commands, as users do."""

from __future__ import annotations

import json
import os
import shutil
import subprocess
import sys
import time
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from PIL import Image

from benchmarks.field.inputs import (
    NOISE,
    Array,
    gps_places,
    gps_residual,
    lenses_are_real,
    photos_alone,
    with_poses,
)
from benchmarks.field.sets import FieldSet, lay_out
from biresnerf.data.formats.read_dataset import read_poses
from biresnerf.geometry.pose_error import pose_error

Row = dict[str, Any]
RUNS = ("alone", "noisy", "owner")  # photos alone, with noisy poses, with what the owner published
NICE = ("nice", "-n", "10")


@dataclass(frozen=True)
class Asked:
    """The battery's settings.

    Attributes:
        data: the folder of clones and results.
        photos: the most photos of a set.
        options: the product's, as on its command line.
        url: a service that gets the set as well.
        runs: which of `RUNS` to do.
        keep: reuses existing results of the product.
    """

    data: Path
    photos: int | None
    options: tuple[str, ...]
    url: str | None
    runs: tuple[str, ...]
    keep: bool


def run_set(field_set: FieldSet, asked: Asked) -> Row:
    """Returns a row of the table. COLMAP's part is done once; results are in ``data``/work/NAME."""
    source, work = lay_out(field_set, asked.data), asked.data / "work" / field_set.name
    names = field_set.photos[: asked.photos]
    colmap = _placed_by_colmap(source, names, work / "colmap")
    places = gps_places(source, names)
    frames = _true_frames(colmap)
    truth = poses_of(frames)
    judge = Judge(truth, places, work / "colmap")
    with Image.open(source / names[0]) as first:
        size = first.size
    row: Row = {
        "set": field_set.name,
        "kind": field_set.kind,
        "photos": len(names),
        "size": size,
        "gps": len(places),
        "date": time.strftime("%Y-%m-%d", time.gmtime()),
    }
    for name, model in colmap.items():
        judged = judge.of(poses_of(model.get("frames", [])), work / "colmap" / name / "best")
        row[name] = {key: value for key, value in model.items() if key != "frames"} | judged
    given = {"alone": photos_alone(source, names, work / "alone")}
    if truth:
        folder = photos_alone(source, names, work / "noisy")
        given["noisy"] = with_poses(folder, frames, noise=NOISE)
        before = read_poses(folder / "transforms.json")
        row["given"] = judge.of({Path(name).name: pose for name, pose in before.items()}, None)
    if field_set.owner_poses:
        given["owner"] = source
    for name, folder in given.items():
        if name in asked.runs:
            row[name] = _refined(folder, work / f"{name}-out", asked, judge, None)
    if asked.url is not None:
        row["http"] = _refined(given.get("noisy", given["alone"]), work / "http-out", asked, judge, asked.url)
    return row


class Judge:
    """Measures a set's poses against what is known about it.

    Args:
        truth: world_from_cam [4, 4] by file name.
        places: GPS positions by file name.
        matches: the folder of `colmap_child.place`.
    """

    def __init__(self, truth: dict[str, Array], places: dict[str, Array], matches: Path):
        self._truth, self._places, self._matches = truth, places, matches

    def of(self, poses: dict[str, Array], model: Path | None) -> Row:
        """Errors (deg) after alignment and in the caller's frame, distance from GPS (m), misfit of matches (px)."""
        row: Row = {"gps_m": gps_residual(poses, self._places)}
        shared = sorted(self._truth.keys() & poses.keys())
        if len(shared) > 2:
            error = pose_error(
                np.stack([poses[name] for name in shared]), np.stack([self._truth[name] for name in shared])
            )
            aligned = error.aligned_robust
            row |= {
                "deg": aligned.rotation_deg.mean,
                "worst_deg": aligned.rotation_deg.max,
                "centre_percent": aligned.centre_percent.mean,
                "own_frame_deg": error.own_frame.rotation_deg.mean,
            }
        if model is not None:
            row |= child(
                "measure", self._matches, model=str(model), matches=str(self._matches / "matches.npz")
            )
        return row


def child(step: str, work: Path, **request: Any) -> Row:
    """Runs a step of `colmap_child`; returns its answer."""
    path, answer = work / f"{step}.request.json", work / f"{step}.json"
    answer.unlink(missing_ok=True)
    path.write_text(json.dumps({"step": step, "work": str(work), "answer": str(answer), **request}), "utf-8")
    with (work / f"{step}.log").open("wb") as log:
        command = [*NICE, sys.executable, "-m", "benchmarks.field.colmap_child", str(path)]
        code = subprocess.run(command, stdout=log, stderr=log, check=False).returncode
    if code != 0:
        return {"error": f"COLMAP ended with {code}"}
    found: Row = json.loads(answer.read_text("utf-8"))
    return found


def _true_frames(colmap: Row) -> list[Row]:
    """Frames of COLMAP's model with richer lenses, else of its default one; empty if neither can be the truth."""
    for name in ("reference", "peer"):
        frames: list[Row] = colmap.get(name, {}).get("frames", [])
        if len(frames) > 2 and lenses_are_real(frames):
            return frames
    return []


def _placed_by_colmap(source: Path, names: tuple[str, ...], work: Path) -> Row:
    done = work / "place.json"
    if done.is_file() and json.loads((work / "place.request.json").read_text("utf-8"))["names"] == [*names]:
        found: Row = json.loads(done.read_text("utf-8"))
        return found
    shutil.rmtree(work, ignore_errors=True)
    work.mkdir(parents=True)
    return child("place", work, root=str(source), names=names)


def poses_of(frames: list[Row]) -> dict[str, Array]:
    """world_from_cam by file name."""
    return {Path(frame["name"]).name: np.array(frame["world_from_cam"]) for frame in frames}


def _refined(folder: Path, out: Path, asked: Asked, judge: Judge, url: str | None) -> Row:
    """The product's result for a folder, by `refine`, or by `submit` if there is a ``url``."""
    if asked.keep and (out / "report.json").is_file():
        return _read(out, judge)
    shutil.rmtree(out, ignore_errors=True)
    program = str(Path(sys.executable).with_name("biresnerf"))
    where = ["submit", str(folder), "--url", url] if url else ["refine", str(folder)]
    ended = subprocess.run(
        [*NICE, program, *where, "-o", str(out), *asked.options, "--json"],
        capture_output=True, text=True, check=False, env=os.environ,
    )  # fmt: skip
    if ended.returncode != 0 or not (out / "report.json").is_file():
        return {"code": ended.returncode, "error": (ended.stderr or ended.stdout).strip()[-600:]}
    return _read(out, judge)


def _read(out: Path, judge: Judge) -> Row:
    report = json.loads((out / "report.json").read_text("utf-8"))
    poses = {Path(name).name: pose for name, pose in read_poses(out / "transforms.json").items()}
    return said(report) | judge.of(poses, out / "colmap" / "sparse" / "0")


def said(report: Row) -> Row:
    """What a report tells the user about the poses."""
    images = report["images"]
    known = [image for image in images if (image["uncertainty"] or {}).get("rotation_deg") is not None]
    return {
        "seconds": round(sum(report["seconds"].values())),
        "images": len(images),
        "placed": sum(image["pose_source"].startswith(("matches", "colmap")) for image in images),
        "known": len(known),
        "bound_deg": max((image["uncertainty"]["rotation_deg"] for image in known), default=None),
        "verdict": (report["verdict"] or {}).get("verdict"),
        "why": (report["verdict"] or {}).get("why", [])[:1],
        "warnings": report["warnings"],
    }
