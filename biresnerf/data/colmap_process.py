"""Running COLMAP in a child process: time limit, stop on request, its death with ours, its crash told as an error."""

from __future__ import annotations

import ctypes
import json
import os
import signal
import subprocess
import sys
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

from biresnerf.errors import InputError, Interrupted, RefinementError

CHILD = Path(__file__).with_name("colmap_child.py")
_POLL_S = 0.2
_PR_SET_PDEATHSIG = 1
# Loaded here: between fork and exec it would be too late to load anything.
_LIBC = ctypes.CDLL(None) if sys.platform == "linux" else None


def run_colmap(
    request: dict[str, Any], work: Path, should_stop: Callable[[], bool], limit_s: float
) -> dict[str, Any]:
    """The answer of `colmap_child` to a request; its log and files lie in the folder ``work``.

    Raises:
        InputError: ``seed_timeout``.
        Interrupted: ``should_stop`` said so.
        RefinementError: ``seeding_crashed``: COLMAP itself failed.
    """
    request_path, log_path = work / "request.json", work / "colmap.log"
    request_path.write_text(json.dumps(request), "utf-8")
    command = [sys.executable, "-P", str(CHILD), str(request_path)]
    # Sums over threads come out in another order each time; a guided mapping promises the same poses again.
    environment = {**os.environ, "OMP_NUM_THREADS": "1"} if request["task"] == "from_given" else None
    with log_path.open("wb") as log:
        child = subprocess.Popen(
            command,
            stdin=subprocess.DEVNULL,
            stdout=log,
            stderr=log,
            env=environment,
            start_new_session=True,
            preexec_fn=_die_with_parent if sys.platform == "linux" else None,
        )
        try:
            _wait(child, Path(request["root"]).name, should_stop, limit_s)
        finally:
            if child.poll() is None:
                os.killpg(child.pid, signal.SIGKILL)
                child.wait()
    answer = Path(request["answer"])
    if child.returncode != 0 or not answer.is_file():
        tail = log_path.read_text("utf-8", errors="replace").strip().splitlines()[-3:]
        raise RefinementError("seeding_crashed", f"COLMAP ended with {child.returncode}: {' | '.join(tail)}")
    result: dict[str, Any] = json.loads(answer.read_text("utf-8"))
    return result


def _wait(
    child: subprocess.Popen[bytes], root_name: str, should_stop: Callable[[], bool], limit_s: float
) -> None:
    end = time.monotonic() + limit_s
    while child.poll() is None:
        if should_stop():
            raise Interrupted("stopped while COLMAP looked for poses")
        if time.monotonic() > end:
            raise InputError(
                "seed_timeout",
                f"COLMAP did not finish within {limit_s:g} s.",
                where=root_name,
                mend="Give fewer images, or a transforms.json with approximate poses.",
            )
        time.sleep(_POLL_S)


def _die_with_parent() -> None:
    assert _LIBC is not None
    _LIBC.prctl(_PR_SET_PDEATHSIG, signal.SIGKILL)
