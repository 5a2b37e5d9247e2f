"""The program that validates a dataset: `python -m workers.datasets.dataset_check_process FOLDER`.

Writes lines of JSON to standard output: ``{"photos_read": n, "photos": all}`` after each photo, and at the end
``{"report": {...}}`` (exit status 0) or ``{"error": a fault}`` (exit status 2). Writes what pages show of the set into
a folder beside it. Exits with `EXIT_DISK` if the disk is full. It reads untrusted files, so it first limits its memory,
CPU time and file sizes. Loads neither torch nor pycolmap; the job finds missing poses.
"""

from __future__ import annotations

import json
import os
import resource
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

from biresnerf.errors import InputError
from workers.process.disk_space import EXIT_DISK, failed_for_room
from workers.process.memory_limits import CHECK_BYTES, CHECK_VARIABLE
from workers.records import shown_folder

EXIT_INPUT_ERROR = 2
CPU_S = 3600
FILE_BYTES = 64 * 2**20


def main(folder: Path) -> int:
    """Check ``folder``; returns the exit status."""
    out = os.fdopen(os.dup(1), "w", buffering=1)
    os.dup2(2, 1)  # what libraries print must not mix with the answer

    def told(**said: object) -> None:
        out.write(json.dumps(said) + "\n")

    try:
        answer: dict[str, Any] = {
            "report": check(
                folder, shown_folder(folder), lambda count, all_: told(photos_read=count, photos=all_)
            )
        }
        status = 0
    except MemoryError:
        detail = f"The check needs more than the {_memory_bytes() // 2**20} MiB that it may take."
        hint = "Send smaller photos. The operator can give the service more memory."
        answer = {"error": {"code": "check_crashed", "detail": detail, "hint": hint}}
        status = EXIT_INPUT_ERROR
    except Exception as error:
        if failed_for_room(error, folder):
            return EXIT_DISK
        if not isinstance(error, InputError):
            raise
        where = error.where.replace(f"{folder}/", "").replace(str(folder), "the dataset")
        answer = {"error": error.fault.model_copy(update={"where": where}).model_dump()}
        status = EXIT_INPUT_ERROR
    told(**answer)
    return status


def check(
    folder: Path, shown: Path, on_photo: Callable[[int, int], object] = lambda _count, _all: None
) -> dict[str, Any]:
    """Read ``folder`` and decode every image; returns the findings, and writes ``shown`` for pages.

    Calls ``on_photo`` before the first photo and after each, with the number read so far and that of all.

    Raises:
        InputError: what is wrong, with which file, and a hint.
    """
    from biresnerf.data.formats.read_dataset import read_dataset
    from biresnerf.data.given_poses.likely_reading import pose_question
    from biresnerf.data.photos.alike.copied_photos import without_copies
    from biresnerf.data.photos.alike.turning_object import turning_notes
    from biresnerf.data.photos.images import load_images
    from workers.datasets.shown_set import expected_seconds, preset_here, small_side, write_shown

    sent = {path.relative_to(folder).as_posix() for path in folder.rglob("*")}
    dataset = read_dataset(folder, within=folder)
    on_photo(0, len(dataset))
    images = load_images(
        dataset, small_side(len(dataset)), on_photo=lambda count: on_photo(count, len(dataset))
    )
    question = pose_question(dataset)
    write_shown(dataset, images, folder, sent, shown, question.given_poses if question else ())
    posed = int(dataset.posed.sum())
    return {
        "images": len(dataset),
        "with_pose": posed,
        "without_pose": len(dataset) - posed,
        "poses": "missing" if posed == 0 else "given" if posed == len(dataset) else "partial",
        "cameras": len(dataset.cameras),
        "camera_models": sorted({camera.model for camera in dataset.cameras}),
        "intrinsics": sorted(set(dataset.intrinsics_sources) or {"given"}),
        "format": dataset.source.dialect,
        "masks": sum(frame.mask is not None for frame in dataset.frames),
        "transparency": images.alpha is not None,
        "warnings": [*without_copies(dataset).warnings, *turning_notes(dataset)],
        "pose_question": question and question.model_dump(mode="json"),
        "expected_s": expected_seconds(dataset, unbounded=images.background is None),
        "preset": preset_here(),
    }


def confine() -> None:
    """Limit this process to what a check needs."""
    for kind, amount in (
        (resource.RLIMIT_AS, _memory_bytes()),
        (resource.RLIMIT_CPU, CPU_S),
        (resource.RLIMIT_CORE, 0),
        (resource.RLIMIT_FSIZE, FILE_BYTES),
        (resource.RLIMIT_NOFILE, 256),
    ):
        _, most = resource.getrlimit(kind)
        wanted = amount if most == resource.RLIM_INFINITY else min(amount, most)
        resource.setrlimit(kind, (wanted, wanted))


def _memory_bytes() -> int:
    return int(os.environ.get(CHECK_VARIABLE, CHECK_BYTES))


if __name__ == "__main__":
    confine()
    sys.exit(main(Path(sys.argv[1])))
