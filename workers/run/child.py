"""The process of one job: started in its own session, tied to us, stopped politely and then for good."""

from __future__ import annotations

import asyncio
import contextlib
import os
import signal
from collections.abc import AsyncIterator, Mapping, Sequence
from pathlib import Path

from workers.process.die_with_parent import dying_with_parent

LINE_BYTES_MAX = 2**20
TAIL_BYTES = 4000


class Child:
    """A running job process. Its standard output is the protocol, its standard error the log."""

    def __init__(self, process: asyncio.subprocess.Process) -> None:
        self._process = process

    @classmethod
    async def start(
        cls, command: Sequence[str], folder: Path, log: Path, variables: Mapping[str, str], nice: int = 0
    ) -> Child:
        """Run ``command FOLDER`` inside ``folder`` with a clean environment; appends stderr to ``log``.

        ``nice``: how much it gives way to other processes, the API's above all.
        """
        # The job reads strangers' files: it gets neither the database's address nor other settings of ours.
        inherited = {name: value for name, value in os.environ.items() if not name.startswith("BIRESNERF_")}
        # ``python -m`` would look for modules in the folder first, where a stranger's json.py may lie.
        inherited["PYTHONSAFEPATH"] = "1"
        with log.open("ab") as errors:
            process = await asyncio.create_subprocess_exec(
                *dying_with_parent([*command, str(folder)], signal_number=signal.SIGKILL, nice=nice),
                stdin=asyncio.subprocess.DEVNULL,
                stdout=asyncio.subprocess.PIPE,
                stderr=errors,
                cwd=folder,
                env={**inherited, **variables},
                start_new_session=True,
                limit=LINE_BYTES_MAX,
            )
        return cls(process)

    @property
    def pid(self) -> int:
        """Process id, also the id of its process group."""
        return self._process.pid

    async def lines(self) -> AsyncIterator[bytes]:
        """Lines of standard output until it closes; one longer than a mebibyte is dropped."""
        assert self._process.stdout is not None, "started with a pipe"
        while True:
            try:
                line = await self._process.stdout.readline()
            except ValueError:
                continue
            if not line:
                return
            yield line

    async def wait(self) -> int:
        """Exit status (negative: killed by that signal), after taking its descendants down too."""
        status = await self._process.wait()
        self.kill()
        return status

    async def stop(self, grace_s: float) -> None:
        """Ask it to write a checkpoint and exit; kill it when it takes longer than ``grace_s``."""
        with contextlib.suppress(ProcessLookupError):
            os.killpg(self.pid, signal.SIGTERM)
        try:
            await asyncio.wait_for(self._process.wait(), grace_s)
        except TimeoutError:
            self.kill()

    def kill(self) -> None:
        """Kill the process and all it started."""
        with contextlib.suppress(ProcessLookupError):
            os.killpg(self.pid, signal.SIGKILL)


def log_tail(log: Path) -> str:
    """The end of a log file, fit for an error message."""
    if not log.exists():
        return ""
    with log.open("rb") as file:
        file.seek(max(0, log.stat().st_size - TAIL_BYTES))
        # The database stores no NUL in text.
        return file.read().decode(errors="replace").replace("\0", "\ufffd").strip()
