"""A service for as long as a program needs one: on a free port, with a private database, in a folder of its own."""

from __future__ import annotations

import os
import re
import shutil
import signal
import subprocess
import sys
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from biresnerf.errors import BiresnerfError
from workers.process.die_with_parent import dying_with_parent

_STOP_S = 40.0
_READY = re.compile(r"ready at (\S+)")


@contextmanager
def temporary_service() -> Iterator[str]:
    """Yields the address of a temporary `biresnerf up` with default settings; deletes its files at the end.

    Raises:
        BiresnerfError: it did not start; the message ends with its log.
    """
    home = Path(tempfile.mkdtemp(prefix="biresnerf-temporary-"))
    home.chmod(0o711)  # if root starts the database, it runs as another user
    environment = {name: value for name, value in os.environ.items() if not name.startswith("BIRESNERF_")}
    environment["BIRESNERF_DATA_DIR"] = str(home / "data")
    log = home / "service.log"
    command = [sys.executable, "-m", "biresnerf.command_line", "up", "--port", "0", "--slots", "1"]
    with log.open("wb") as errors:
        # In its own session it does not receive Ctrl-C; `dying_with_parent` ends it if this process is killed.
        process = subprocess.Popen(
            dying_with_parent(command, signal_number=signal.SIGINT),
            env=environment,
            stdout=subprocess.PIPE,
            stderr=errors,
            start_new_session=True,
        )
    try:
        found = _READY.match(process.stdout.readline().decode()) if process.stdout else None
        if found is None:
            raise BiresnerfError(f"The service did not start:\n{log.read_text(errors='replace')[-3000:]}")
        yield found[1]
    finally:
        _stop(process)
        shutil.rmtree(home, ignore_errors=True)


def _stop(process: subprocess.Popen[bytes]) -> None:
    process.send_signal(signal.SIGINT)
    try:
        process.wait(_STOP_S)
    except subprocess.TimeoutExpired:
        os.killpg(process.pid, signal.SIGKILL)
        process.wait()
    if process.stdout:
        process.stdout.close()
