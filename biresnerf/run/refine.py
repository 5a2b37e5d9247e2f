"""`biresnerf.refine`: a whole refinement in one call, for programs, notebooks and the command line."""

from __future__ import annotations

import signal
from collections.abc import Callable, Sequence
from contextlib import ExitStack
from pathlib import Path
from typing import TYPE_CHECKING, Any

from biresnerf.data.formats.read_dataset import read_dataset
from biresnerf.data.formats.simple.poses_json import POSES
from biresnerf.data.photos.video.video_frames import VideoReading
from biresnerf.errors import InputError
from biresnerf.openmp import let_waiting_threads_sleep
from biresnerf.options.presets import MethodName
from biresnerf.options.refine_options import parse_options
from biresnerf.progress import OnProgress, told_before_the_run
from biresnerf.result import Result, load
from biresnerf.run.photos_added import joined_to
from biresnerf.run.show_progress import ShownProgress
from biresnerf.run.stop_request import StopRequest
from biresnerf.stages import CHECKPOINT
from biresnerf.write.output_folder import REPORT, OutputFolder

if TYPE_CHECKING:
    from biresnerf.refinement.optimise.methods import Method


def refine(
    input: str | Path,
    output: str | Path,
    /,
    *,
    progress: bool | OnProgress = False,
    should_stop: Callable[[], bool] | None = None,
    overwrite: bool = False,
    fixed_from: str | Path | None = None,
    parts: Sequence[str | Path] = (),
    method: MethodName | Method = "biresnerf",
    **options: Any,
) -> Result:
    """Refine the camera poses of an image set, as the command ``biresnerf refine`` does.

    All files of the result go to `output`. The same call resumes an interrupted run, and begins with stage 2 where only
    options of stage 2 differ.

    Args:
        input: a folder of images, with or without poses, a file with poses, or a video (docs/input.md).
        output: a folder that is empty, new, or holds an unfinished run of the same input and options.
        progress: True draws one bar over the whole run, with the time left: in notebooks, too; lines where there is
            neither a notebook nor a terminal. A function is called with a `Progress` a few times a second.
        should_stop: called after every step, view, frame and photo; once true, a checkpoint and a partial result are
            written. Without it, Ctrl-C or a notebook's stop button does the same.
        fixed_from: a finished result of some of the photos: these keep its poses and lenses, and the others join them.
        parts: results of parts of a large set, or folders of such: their poses and matches are joined, and all cameras
            adjusted together.
        overwrite: remove a finished result from `output` first.
        method: the option of that name, or a method of your own (docs/method.md).
        options: of the refinement, by name, as docs/options.md lists them: ``preset="fast", steps=2000``.

    Returns:
        the result: poses are world_from_cam [n, 4, 4], float64, OpenCV axes, in the input's own frame and scale.

    Raises:
        InputError: the user can fix it: ``invalid_options`` with the nearest name of a wrong one, or a code of
            docs/troubleshooting.md. Those of input, output and options come before torch is loaded.
        RefinementError: the optimisation diverged.
        Interrupted: stopped on request; the checkpoint and a partial result are in `output`, or nothing yet if initial
            poses were still being computed.
    """
    let_waiting_threads_sleep()
    own = None if isinstance(method, str) else method
    asked = parse_options(options if own else {"method": method, **options})
    folder = OutputFolder(Path(output))
    if not overwrite:
        folder.refuse_finished()
    results = [result for part in parts for result in _results_in(Path(part))]
    with ExitStack() as during:
        on_progress = during.enter_context(ShownProgress()) if progress is True else progress or None
        stop = should_stop or during.enter_context(StopRequest(signal.SIGINT))
        watch = told_before_the_run(on_progress or (lambda _progress: None), stop)
        videos = VideoReading(asked.video_frames, watch)
        dataset = read_dataset(Path(input), strict=asked.bad_frames == "refuse", videos=videos)
        if fixed_from is not None:
            dataset, asked = joined_to(dataset, asked, Path(fixed_from))
        from biresnerf.pipeline import refine_poses  # loads torch, which takes seconds

        if overwrite:
            folder.remove_result()
        refine_poses(dataset, output, asked, on_progress, stop, method=own, parts=results)
    return load(output)


def _results_in(folder: Path) -> list[Path]:
    """This finished result, or those in the folder, by name.

    Raises:
        InputError: ``result_missing`` where there is none, or one is not finished.
    """
    inside = sorted(one for one in folder.iterdir() if one.is_dir()) if folder.is_dir() else []
    parts = [folder] if (folder / POSES).is_file() else inside
    unfinished = [one for one in parts if not (one / REPORT).is_file() or (one / CHECKPOINT).is_file()]
    if unfinished or not parts:
        raise InputError(
            "result_missing",
            "is no finished result.",
            where=str(unfinished[0] if unfinished else folder),
            hint="Refine this part first, or name the results of the others one by one.",
        )
    return parts
