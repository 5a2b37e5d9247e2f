"""Frames of a video written as photos, once: beside the video, in video_frames/NAME_mp4/00m12s345.jpg."""

from __future__ import annotations

import json
import shutil
from collections.abc import Callable, Sequence
from contextlib import ExitStack
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from PIL import Image

from biresnerf.data.model.atomic_file import whole_folder
from biresnerf.data.photos.video.choose_frames import SIDE, FrameWatch, choose_frames
from biresnerf.data.photos.video.ffmpeg_frames import DEMUXERS, FrameStream
from biresnerf.errors import InputError

VIDEO_FRAMES = "video_frames"  # the folder, beside the videos
CHOSEN = "chosen.json"  # in the folder of each video: of what file the frames are, and their times
USUAL_COUNT = 120
_QUALITY = 95  # of JPEG, with colours as fine as brightness
_LOOK_EVERY = 30  # frames between two looks at whether to stop


@dataclass(frozen=True)
class VideoReading:
    """How videos are read.

    Attributes:
        count: frames of all videos together; 0 for those that were chosen before, else `USUAL_COUNT`.
        watch: called with what is being done, many times a second; may raise to end it.
    """

    count: int = 0
    watch: Callable[[str], None] = lambda _what: None


EACH_VIDEO = VideoReading()  # as it was read before, else with the usual count


def is_video_name(path: Path) -> bool:
    """Whether the extension is one of a video that is read."""
    return path.suffix.lower() in DEMUXERS


def frames_of_videos(videos: Sequence[Path], root: Path, reading: VideoReading) -> list[Path]:
    """The frames of the videos as photos in ``root``/video_frames, written there unless they are there already.

    Each video gives its share of the count. A folder appears when all its frames are written.

    Raises:
        InputError: ``video_unreadable``, ``video_too_long``, or ``video_frames_not_written`` where the folder cannot be
            written to.
    """
    share = -(-(reading.count or USUAL_COUNT) // len(videos))
    found: list[Path] = []
    for video in videos:
        folder = root / VIDEO_FRAMES / f"{video.stem}_{video.suffix[1:].lower()}"
        kept = _kept(folder, video, share if reading.count else None)
        found += kept if kept is not None else _written(folder, video, share, reading)
    return found


def _source(video: Path) -> dict[str, Any]:
    about = video.stat()
    return {"video": video.name, "bytes": about.st_size, "changed_ns": about.st_mtime_ns}


def _kept(folder: Path, video: Path, share: int | None) -> list[Path] | None:
    """The frames written before, if they are of this very file, and as many as requested."""
    try:
        told = json.loads((folder / CHOSEN).read_text("utf-8"))
        same = told["of"] == _source(video) and share in (None, told["asked"])
        frames = [folder / str(frame["file"]) for frame in told["frames"]]
    except (OSError, ValueError, KeyError, TypeError):
        return None
    inside = all(path.parent == folder and path.is_file() for path in frames)
    return frames if same and inside and frames else None


def _written(folder: Path, video: Path, count: int, reading: VideoReading) -> list[Path]:
    times, sharpness, chosen = _choice(video, count, reading)
    with ExitStack() as stack:
        try:
            staging = stack.enter_context(whole_folder(folder))
        except OSError as error:
            raise InputError(
                "video_frames_not_written",
                f"the frames of a video are written beside it, and this cannot be written to: {error.strerror}.",
                where=str(folder.parent),
                hint="Copy the video to a folder of your own, and give that.",
            ) from None
        names = _names([times[index] for index in chosen])
        _write(video, staging, chosen, names, reading)
        listed = [
            {"file": name, "time_s": round(times[i], 6), "sharpness": round(sharpness[i], 2)}
            for name, i in zip(names, chosen, strict=True)
        ]
        told = {"of": _source(video), "asked": count, "frames": listed}
        (staging / CHOSEN).write_text(json.dumps(told, indent=1), "utf-8")
        shutil.rmtree(folder, ignore_errors=True)
    return [folder / name for name in names]


def _choice(video: Path, count: int, reading: VideoReading) -> tuple[list[float], list[float], list[int]]:
    """The times and the sharpness of all frames, and which are chosen."""
    box = f"w={SIDE}:h={SIDE}:force_original_aspect_ratio=decrease:flags=area"
    stream, seen = FrameStream(video, video.name, f"scale={box}", grey=True), FrameWatch()
    for number, frame in enumerate(stream):
        if number % _LOOK_EVERY == 0:
            reading.watch(f"looking for sharp frames of {video.name}")
        seen.look(frame)
    times = _in_order(stream.times_s, len(seen.sharpness))
    chosen = choose_frames(times, np.array(seen.sharpness), np.array(seen.travelled), count)
    return times.tolist(), seen.sharpness, chosen


def _write(
    video: Path, folder: Path, chosen: Sequence[int], names: Sequence[str], reading: VideoReading
) -> None:
    wanted = "+".join(f"eq(n,{index})" for index in chosen)
    stream = FrameStream(video, video.name, f"select='{wanted}'", grey=False)
    written = 0
    for name, frame in zip(names, stream, strict=False):
        reading.watch(f"writing frames of {video.name}")
        Image.fromarray(frame).save(folder / name, quality=_QUALITY, subsampling=0)
        written += 1
    if written < len(names):
        raise InputError(
            "video_unreadable",
            f"gave {written} of {len(names)} frames when it was read again.",
            where=video.name,
            hint="Leave the video alone while it is read.",
        )


def _in_order(times_s: Sequence[float], count: int) -> NDArray[np.float64]:
    """The times of so many frames, from 0 on; a frame without a time of its own has that of the one before."""
    known = np.array(times_s[:count] or [0.0])
    padded = np.concatenate([known, np.full(count - len(known), known[-1])])
    return np.maximum.accumulate(padded - padded[0])


def _names(times_s: Sequence[float]) -> list[str]:
    """Photos' names by their times, without a dot in them, in the order of time, none twice."""
    names, last = [], -1
    for time_s in times_s:
        last = max(last + 1, round(1000 * time_s))
        minutes, rest = divmod(last, 60_000)
        names.append(f"{minutes:02}m{rest // 1000:02}s{rest % 1000:03}.jpg")
    return names
