"""Whether this container is well: `python -I health.py`, the image's HEALTHCHECK. Exit status 0: it is.

What is asked follows from the command that the container runs: the web process answers that it is ready; the
event loops of worker and dispatcher go on, and a worker holds the lock of its slot, which `health.py live` does not
ask; of any other command the runtime sees for itself whether it runs.
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
# A process itself ends when its loop does nothing for so long.
SILENCE_S = 60.0


def command_line() -> list[str]:
    """The container's command, below an init process where there is one."""
    return Path("/proc/1/cmdline").read_bytes().decode(errors="replace").split("\0")


def trouble_of_api(port: str) -> str:
    """Why the web process is not ready; empty where it is."""
    try:
        with urllib.request.urlopen(f"http://127.0.0.1:{port}/readyz", timeout=ANSWER_S):
            return ""
    except urllib.error.HTTPError as error:
        return error.read(2000).decode(errors="replace")
    except OSError as error:
        return str(error)


def trouble_of_worker(slots: Path) -> str:
    """Why no slot of this container runs; empty where each does."""
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
    """Why the event loop of this container does not go on; empty where it does."""
    shown = [beat.stat().st_mtime for beat in beats.glob(f"{os.uname().nodename}.*")]
    if not shown:
        return f"no process has started yet ({beats} is empty)"
    age_s = time.time() - max(shown)
    return "" if age_s < silence_s else f"the event loop has done nothing for {age_s:.0f} s"


def main() -> int:
    """Exit status of the check; says on standard output what is wrong."""
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
