"""The frames of a video, one after the other, as FFmpeg decodes them in a process of its own.

Turned as the video's metadata say. Videos are untrusted: FFmpeg gets one demuxer, that of the file's name, no
protocol but files, a limit on pixels, and ends with the caller.
"""

from __future__ import annotations

import re
import subprocess
import threading
from collections.abc import Iterator
from pathlib import Path
from typing import IO

import numpy as np
from numpy.typing import NDArray

from biresnerf.data.photos.image_files import MAX_IMAGE_PIXELS
from biresnerf.errors import InputError

# What reads the files of each extension. All others of FFmpeg's, playlists above all, are never tried.
DEMUXERS = {
    **dict.fromkeys((".mp4", ".mov", ".m4v"), "mov"),
    **dict.fromkeys((".mkv", ".webm"), "matroska"),
    ".avi": "avi",
}
MOST_FRAMES = 216_000  # an hour at 60 a second
_TIME = re.compile(rb"\bpts_time:(-?[\d.]+)")
_TO_END_S = 20.0  # for FFmpeg, after its last frame
_ERROR = re.compile(rb"\[(?:error|fatal)\] (.*)")
_FILTER_FLAGS = "bicubic+accurate_rnd+full_chroma_int"


class FrameStream:
    """Decoded frames of one video, and the times that FFmpeg gives for them, complete once all frames are read.

    Attributes:
        times_s: of each frame read so far, from the video's own zero; a little ahead of the frames.
    """

    def __init__(self, video: Path, name: str, filters: str, *, grey: bool) -> None:
        from imageio_ffmpeg import get_ffmpeg_exe

        self._video, self._name, self.times_s, self._problem = video.absolute(), name, list[float](), ""
        self._command = [
            *(get_ffmpeg_exe(), "-nostdin", "-hide_banner", "-loglevel", "level+info", "-nostats"),
            *("-protocol_whitelist", "file,pipe", "-max_pixels", str(MAX_IMAGE_PIXELS)),
            *("-f", DEMUXERS[video.suffix.lower()], "-i", f"file:{self._video}", "-map", "0:v:0"),
            *("-vf", f"{filters},showinfo=checksum=0", "-sws_flags", _FILTER_FLAGS),
            *("-fps_mode", "passthrough"),
            # Phones film in 10 bits, which FFmpeg would write as numbers of 16.
            *("-pix_fmt", "gray" if grey else "rgb24", "-f", "image2pipe", "-c:v", "pgm" if grey else "ppm"),
            "pipe:1",
        ]

    def __iter__(self) -> Iterator[NDArray[np.uint8]]:
        """uint8 [h, w] or [h, w, 3].

        Raises:
            InputError: ``video_unreadable``, where no frame can be decoded; ``video_too_long``. A damaged video yields
                the frames before the damage.
        """
        with subprocess.Popen(self._command, stdout=subprocess.PIPE, stderr=subprocess.PIPE) as process:
            assert process.stdout is not None, "started with a pipe"
            listening = threading.Thread(target=self._listen, args=(process.stderr,), daemon=True)
            listening.start()
            count, ended = 0, False
            try:
                while (frame := _next_picture(process.stdout)) is not None:
                    count += 1
                    if count > MOST_FRAMES:
                        raise InputError(
                            "video_too_long",
                            f"has more than {MOST_FRAMES} frames.",
                            where=self._name,
                            hint="Cut it: a few minutes around the scene are enough.",
                        )
                    yield frame
                process.stdout.close()  # so that FFmpeg ends, even if it has more to write
                process.wait(_TO_END_S)
                ended = True
            finally:
                if not ended:
                    process.kill()
                listening.join()
        if count == 0:
            raise InputError(
                "video_unreadable",
                f"no frame of it can be decoded ({self._problem[:200].strip() or 'FFmpeg says nothing'}).",
                where=self._name,
                hint="Convert it to MP4 with H.264, or save frames of it as photos.",
            )

    def _listen(self, messages: IO[bytes] | None) -> None:
        for line in messages or ():
            found = _TIME.search(line)
            if found is not None:
                self.times_s.append(float(found[1]))
            elif (error := _ERROR.search(line)) is not None and not self._problem:
                self._problem = error[1].decode(errors="replace").replace(str(self._video), self._name)


def _next_picture(stream: IO[bytes]) -> NDArray[np.uint8] | None:
    """The next PGM or PPM of 8 bits; None at the end, also in the midst of one."""
    kind = stream.readline()
    size, most = stream.readline().split(), stream.readline()
    if kind not in (b"P5\n", b"P6\n") or len(size) != 2 or most != b"255\n":
        return None
    width, height = int(size[0]), int(size[1])
    channels = 3 if kind == b"P6\n" else 1
    content = stream.read(width * height * channels)
    if len(content) < width * height * channels:
        return None
    pixels = np.frombuffer(content, dtype=np.uint8)
    return pixels.reshape(height, width, 3) if channels == 3 else pixels.reshape(height, width)
