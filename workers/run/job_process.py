"""The program of one job's child process: `python -m workers.run.job_process JOB_FOLDER`.

Reads ``job.json``, writes one line of JSON per report to standard output, everything else to standard error.
Exit status: 0 done; 2 the user's mistake, 3 the refinement failed (both described in ``error.json``); 4 out of
memory; 5 the disk is full; 6 to be done in parts, by jobs with the options of ``split.json``; 143 stopped by SIGTERM
after writing a checkpoint, if there was anything to keep; 1 anything else, described for the operator in ``crash.txt``.
"""

from __future__ import annotations

import contextlib
import errno
import json
import logging
import os
import shutil
import signal
import sys
import threading
import traceback
from pathlib import Path
from typing import TYPE_CHECKING, Literal, TextIO

from pydantic import TypeAdapter

from biresnerf.errors import InputError, Interrupted, RefinementError
from biresnerf.frozen_model import FrozenModel
from biresnerf.openmp import let_waiting_threads_sleep
from biresnerf.options.formats import ExportName, PosesOf
from biresnerf.options.refine_options import RefineOptions, parse_options
from biresnerf.progress import Progress
from biresnerf.stages import Stage
from workers.process.disk_space import EXIT_DISK, failed_for_room
from workers.records import CRASH_NAME, EXIT_SPLIT, SPLIT_NAME

if TYPE_CHECKING:
    from biresnerf.data.model.dataset import Dataset

EXIT_BUG = 1
EXIT_INPUT = 2
EXIT_REFINEMENT = 3
EXIT_MEMORY = 4
EXIT_STOPPED = 128 + signal.SIGTERM


class Split(FrozenModel):
    """When to ask for parts: above so many photos, and about how many each is to have at most."""

    above: int
    most: int


class Order(FrozenModel):
    """``job.json``: relative paths are below the job folder."""

    task: Literal["refine", "export"] = "refine"
    input: Path
    output: Path
    options: dict[str, object]
    result: Path | None = None  # that is exported, or whose poses stay
    title: str | None = None  # of the report
    parts: Path | None = None  # folders with the results of the job's parts
    split: Split | None = None


def main(folder: Path) -> int:
    """Run the job in ``folder``; returns the exit status."""
    let_waiting_threads_sleep()
    protocol = _protocol_only()
    logging.basicConfig(level=logging.INFO, stream=sys.stderr, format="%(asctime)s %(name)s %(message)s")
    stop = _Stop()
    signal.signal(signal.SIGTERM, lambda *_: stop.ask())
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    try:
        os.chdir(folder)
        return _run(protocol, stop)
    except Exception as error:  # noqa: BLE001 - the last line of defence: a bug ends in a file and in the status
        return _unexpected(error)


def _run(protocol: TextIO, stop: _Stop) -> int:
    try:
        order = Order.model_validate_json(Path("job.json").read_bytes())
        if order.task == "export":
            _export(order, stop)
        else:
            return _refine(order, parse_options(order.options), protocol, stop)
    except Interrupted:
        return EXIT_STOPPED
    except (InputError, RefinementError) as error:
        if failed_for_room(error, Path(".")):
            return EXIT_DISK
        Path("error.json").write_text(error.fault.model_dump_json())
        sys.stderr.write(f"{error}\n")
        return EXIT_INPUT if isinstance(error, InputError) else EXIT_REFINEMENT
    return 0


def _unexpected(error: Exception) -> int:
    if failed_for_room(error, Path(".")):
        return EXIT_DISK
    with contextlib.suppress(OSError):
        Path(CRASH_NAME).write_text(traceback.format_exc())
    sys.stderr.write(f"The program failed ({type(error).__name__}).\n")
    return EXIT_MEMORY if is_out_of_memory(error) else EXIT_BUG


class _Stop:
    """Handles SIGTERM: stop soon and keep what there is, or end at once if there is nothing to keep."""

    def __init__(self) -> None:
        self.asked = threading.Event()
        self.stage: Stage = "preparing"

    def ask(self) -> None:
        if self.stage == "preparing":
            os._exit(EXIT_STOPPED)  # importing torch or reading images cannot be interrupted quickly
        self.asked.set()


def is_out_of_memory(error: Exception) -> bool:
    """Whether the error is a lack of memory, which smaller options may avoid."""
    if isinstance(error, MemoryError) or (isinstance(error, OSError) and error.errno == errno.ENOMEM):
        return True
    # torch's own, of the GPU (a class) and of the CPU (a text); not imported here, as most jobs never fail.
    reported = type(error).__name__ == "OutOfMemoryError" or "DefaultCPUAllocator" in str(error)
    return isinstance(error, RuntimeError) and reported


def _refine(order: Order, options: RefineOptions, protocol: TextIO, stop: _Stop) -> int:
    from biresnerf.data.formats.read_dataset import read_dataset
    from biresnerf.data.photos.video.video_frames import VideoReading
    from biresnerf.run.photos_added import joined_to
    from biresnerf.write.output_folder import OutputFolder

    source: Path | Dataset = order.input
    large = order.split is not None and _may_be_split(order, order.split)
    if order.result is not None or large:
        videos = VideoReading(options.video_frames)
        source = read_dataset(order.input, strict=options.bad_frames == "refuse", videos=videos)
        if order.result is not None:
            source, options = joined_to(source, options, order.result)
        elif order.split is not None and _asks_for_parts(source, options, order.split):
            return EXIT_SPLIT
    from biresnerf.pipeline import refine_poses  # loads torch

    def tell(progress: Progress) -> None:
        stop.stage = progress.stage
        protocol.write(progress.model_dump_json() + "\n")
        protocol.flush()

    try:
        refine_poses(
            source,
            OutputFolder(order.output, keep_reusable=True, title=order.title),
            options,
            on_progress=tell,
            should_stop=stop.asked.is_set,
            parts=sorted(order.parts.iterdir()) if order.parts is not None else (),
        )
    finally:
        _give_video_frames(order)
    return 0


def _may_be_split(order: Order, split: Split) -> bool:
    """Whether there are so many files, and no work of an earlier attempt, which would be lost."""
    started = any(order.output.iterdir())
    return not started and sum(1 for path in order.input.rglob("*") if path.is_file()) > split.above


def _asks_for_parts(dataset: Dataset, options: RefineOptions, split: Split) -> bool:
    """Write what jobs are to refine the parts, if there are enough photos to be used."""
    from biresnerf.run.split_set import part_options, photos_of_parts

    if len(options.photos or dataset) - len(options.leave_out) <= split.above:
        return False
    parts = photos_of_parts(dataset, options, split.most)
    if len(parts) < 2:
        return False
    asked = [part_options(options, photos).model_dump(mode="json", exclude_unset=True) for photos in parts]
    Path(SPLIT_NAME).write_text(json.dumps(asked))
    return True


def _give_video_frames(order: Order) -> None:
    """Add the frames of a video that the result names: nobody else has them."""
    from biresnerf.data.photos.video.video_frames import CHOSEN, VIDEO_FRAMES

    frames = order.input / VIDEO_FRAMES
    if any(frames.glob(f"*/{CHOSEN}")):
        shutil.copytree(frames, order.output / VIDEO_FRAMES, copy_function=os.link, dirs_exist_ok=True)


def _export(order: Order, stop: _Stop) -> None:
    """Write the result in more formats; the input has the photos if a format needs them."""
    from biresnerf.data.formats.codec import WriteContext
    from biresnerf.data.formats.result_formats import export_result, read_result

    assert order.result is not None, "every export names it"
    names = TypeAdapter(tuple[ExportName, ...]).validate_python(order.options["formats"])
    photos = order.input if any(order.input.iterdir()) else None
    refined = read_result(order.result, photos)
    poses_of = TypeAdapter(PosesOf).validate_python(order.options.get("poses_of", "camera"))
    _, notes = export_result(
        refined, order.output, names, WriteContext(should_stop=stop.asked.is_set), poses_of
    )
    for note in notes:
        logging.getLogger(__name__).warning("%s", note)


def _protocol_only() -> TextIO:
    """Reserve standard output for reports: what libraries print goes to standard error."""
    protocol = os.fdopen(os.dup(1), "w", encoding="utf-8")
    os.dup2(2, 1)
    return protocol


if __name__ == "__main__":
    status = main(Path(sys.argv[1]))
    logging.shutdown()
    sys.stderr.flush()
    # Everything is on disk and reported. A cancelling user need not wait for torch to unload.
    os._exit(status)
