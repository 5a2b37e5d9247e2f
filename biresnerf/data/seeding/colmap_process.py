"""Running COLMAP in a child process: it has a time limit, stops on request and dies with its parent."""

from __future__ import annotations

import ctypes
import json
import logging
import os
import shutil
import signal
import subprocess
import sys
import time
from collections.abc import Callable
from pathlib import Path
from typing import IO, Any

from biresnerf.data.seeding.colmap_child import SAYS
from biresnerf.errors import InputError, Interrupted, RefinementError

logger = logging.getLogger(__name__)

CHILD = Path(__file__).with_name("colmap_child.py")
LOG = "colmap.log"
_POLL_S = 0.2
_PR_SET_PDEATHSIG = 1
# Loaded here: between fork and exec it would be too late to load anything.
_LIBC = ctypes.CDLL(None) if sys.platform == "linux" else None


def run_colmap(
    request: dict[str, Any],
    work: Path,
    should_stop: Callable[[], bool],
    limit_s: float,
    log_folder: Path | None = None,
    look: Callable[[], None] = lambda: None,
) -> dict[str, Any]:
    """The answer of `colmap_child` to a request; its files lie in the folder ``work``.

    What it says of its progress goes to the log of this module; all that COLMAP says is kept as colmap.log in
    ``log_folder``, unless it was stopped. ``look`` is called while it runs, a few times a second.

    Raises:
        InputError: ``seed_timeout``.
        Interrupted: ``should_stop`` returned true.
        RefinementError: ``seeding_crashed``: COLMAP itself failed.
    """
    request_path, log_path = work / "request.json", work / LOG
    request_path.write_text(json.dumps(request), "utf-8")
    command = [sys.executable, "-P", str(CHILD), str(request_path)]
    # Sums over threads come out in another order each time; a guided mapping promises the same poses again.
    environment = {**os.environ, "OMP_NUM_THREADS": "1"} if request["mapping_threads"] == 1 else None
    with log_path.open("wb") as log, log_path.open("rb") as said:
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
            _wait(child, said, Path(request["set"]).name, should_stop, limit_s, look)
            _keep(log_path, log_folder)
        except InputError:
            _keep(log_path, log_folder)
            raise
        finally:
            if child.poll() is None:
                os.killpg(child.pid, signal.SIGKILL)
                child.wait()
    answer = Path(request["answer"])
    if child.returncode != 0 or not answer.is_file():
        said_last = log_path.read_text("utf-8", errors="replace").strip().splitlines()[-1:]
        logger.info("COLMAP ended with %s: %s", child.returncode, "".join(said_last).replace(str(work), "…"))
        raise _crashed(child.returncode)
    result: dict[str, Any] = json.loads(answer.read_text("utf-8"))
    return result


def _wait(
    child: subprocess.Popen[bytes],
    said: IO[bytes],
    set_name: str,
    should_stop: Callable[[], bool],
    limit_s: float,
    look: Callable[[], None],
) -> None:
    end = time.monotonic() + limit_s
    while True:
        running = child.poll() is None
        for line in said.read().decode("utf-8", errors="replace").splitlines():
            if line.startswith(SAYS):
                logger.info("%s", line.removeprefix(SAYS))
        if not running:
            return
        look()
        if should_stop():
            raise Interrupted("stopped while COLMAP looked for poses")
        if time.monotonic() > end:
            raise InputError(
                "seed_timeout",
                f"COLMAP did not finish within {limit_s:g} s.",
                where=set_name,
                hint="Give fewer images, or approximate poses.",
            )
        time.sleep(_POLL_S)


def _crashed(status: int) -> RefinementError:
    if status == -signal.SIGKILL:
        return RefinementError(
            "seeding_crashed",
            "COLMAP was killed while it looked for feature matches, most likely for want of memory.",
            hint="Use fewer or smaller photos, or more memory.",
        )
    return RefinementError(
        "seeding_crashed",
        "COLMAP failed while it looked for feature matches. This is a fault of the program, not of the photos.",
        hint=f"Please report it with {LOG} of the output folder. start=given refines given poses without matches.",
    )


def _keep(log_path: Path, folder: Path | None) -> None:
    if folder is not None:
        folder.mkdir(parents=True, exist_ok=True)
        shutil.copyfile(log_path, folder / LOG)


def _die_with_parent() -> None:
    assert _LIBC is not None
    _LIBC.prctl(_PR_SET_PDEATHSIG, signal.SIGKILL)
