"""Checks this container's health: `python -I health.py`, the image's HEALTHCHECK. Exit status 0: healthy.

The check depends on the container's command. The web process must answer that it is ready; the event loops of worker
and dispatcher must be running, and a worker must hold its slot's lock, unless called as `health.py live`. For other
commands, the container runtime sees whether they run.
"""

from __future__ import annotations

import fcntl
import os
import sys
import time
import urllib.error
import urllib.request
from pathlib import Path

ANSWER_S = 8.0
# A process whose loop hangs for so long ends itself.
SILENCE_S = 60.0


def command_line() -> list[str]:
    """The container's command, below an init process where there is one."""
    return Path("/proc/1/cmdline").read_bytes().decode(errors="replace").split("\0")


def trouble_of_api(port: str) -> str:
    """Why the web process is not ready; empty if it is."""
    try:
        with urllib.request.urlopen(f"http://127.0.0.1:{port}/readyz", timeout=ANSWER_S):
            return ""
    except urllib.error.HTTPError as error:
        return error.read(2000).decode(errors="replace")
    except OSError as error:
        return str(error)


def trouble_of_worker(slots: Path) -> str:
    """Why a slot of this container does not run; empty if all do."""
    locks = list(slots.glob(f"{os.uname().nodename}.*"))
    for lock in locks:
        with lock.open("rb") as file:
            try:
                fcntl.flock(file, fcntl.LOCK_SH | fcntl.LOCK_NB)
            except BlockingIOError:
                continue
            return f"nobody holds {lock}"
    return "" if locks else f"no slot has started yet ({slots} is empty)"


def trouble_of_loop(beats: Path, silence_s: float = SILENCE_S) -> str:
    """Why this container's event loop counts as hung; empty if it runs."""
    shown = [beat.stat().st_mtime for beat in beats.glob(f"{os.uname().nodename}.*")]
    if not shown:
        return f"no process has started yet ({beats} is empty)"
    age_s = time.time() - max(shown)
    return "" if age_s < silence_s else f"the event loop has done nothing for {age_s:.0f} s"


def main() -> int:
    """Run the check; returns the exit status and prints what is wrong."""
    words = command_line()
    trouble = ""
    if "api" in words or "up" in words:
        trouble = trouble_of_api(os.environ["BIRESNERF_PORT"])
    elif {"worker", "dispatcher"} & set(words):
        data = Path(os.environ["BIRESNERF_DATA_DIR"])
        trouble = trouble_of_loop(data / "beats")
        if "worker" in words and "live" not in sys.argv[1:]:
            trouble = trouble or trouble_of_worker(data / "slots")
    sys.stdout.write(trouble)
    return 1 if trouble else 0


if __name__ == "__main__":
    sys.exit(main())
