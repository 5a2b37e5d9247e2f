"""The progress of a run for people: one bar over the whole of it, on a terminal and in notebooks; else lines."""

from __future__ import annotations

import sys
import time
from contextlib import ExitStack
from types import TracebackType

from tqdm.auto import tqdm
from tqdm.contrib.logging import logging_redirect_tqdm

from biresnerf.progress import Progress

LINE_EVERY_S = 10.0  # between two lines where there is no bar
BAR = "{desc} {percentage:3.0f} %|{bar}| {elapsed}{postfix}"


class ShownProgress:
    """Shows each `Progress` that it is called with, on standard error; in a `with` block."""

    def __init__(self) -> None:
        self._bar: tqdm[None] | None = None
        self._open = ExitStack()
        self._printed_at, self._stage, self._message = -LINE_EVERY_S, "", ""

    def __enter__(self) -> ShownProgress:
        if sys.stderr.isatty() or "ipykernel" in sys.modules:
            self._bar = self._open.enter_context(tqdm(total=1.0, bar_format=BAR, leave=False))
            self._open.enter_context(logging_redirect_tqdm())
        return self

    def __exit__(
        self, _kind: type[BaseException] | None, _error: BaseException | None, _trace: TracebackType | None
    ) -> None:
        self._open.close()

    def __call__(self, progress: Progress) -> None:
        detail = in_words(progress)
        news = progress.stage == "preparing" and progress.message not in {"", self._message}
        if self._bar is not None:
            self._bar.n = progress.fraction
            self._bar.set_description_str(progress.stage, refresh=False)
            self._bar.set_postfix_str(detail)
            if news:
                self._bar.write(progress.message, sys.stderr)
        elif news or progress.stage != self._stage or time.monotonic() - self._printed_at >= LINE_EVERY_S:
            self._printed_at = time.monotonic()
            sys.stderr.write(f"{progress.stage:<10} {100 * progress.fraction:3.0f} % {detail}\n")
        self._stage, self._message = progress.stage, progress.message


def in_words(progress: Progress) -> str:
    """Step, loss, training PSNR and time left, as far as known."""
    parts = []
    if progress.steps_total:
        parts.append(f"step {progress.step}/{progress.steps_total}")
    if "loss" in progress.metrics:
        parts.append(f"loss {progress.metrics['loss']:.5f}")
    if "psnr" in progress.metrics:
        parts.append(f"train PSNR {progress.metrics['psnr']:.1f} dB")
    if progress.eta_s is not None and progress.eta_s > 0:
        minutes, seconds = divmod(round(progress.eta_s), 60)
        busy = " (the machine is busy now)" if progress.metrics.get("machine_busy") else ""
        parts.append(f"{minutes}:{seconds:02d} left{busy}")
    if progress.message:
        parts.append(progress.message)
    return "  ".join(parts)
