"""A job's process: started in its own session, tied to us; stopped by a signal, killed if that does not help."""

from __future__ import annotations

import asyncio
import contextlib
import os
import signal
import subprocess
import threading
from collections.abc import AsyncIterator, Mapping, Sequence
from pathlib import Path

from workers.process.die_with_parent import dying_with_parent

LINE_BYTES_MAX = 2**20
TAIL_BYTES = 4000
_TICKS_PER_S = os.sysconf("SC_CLK_TCK")


class Child:
    """A running job process. Its standard output is the protocol, its standard error the log."""

    def __init__(self, process: subprocess.Popen[bytes], output: asyncio.StreamReader) -> None:
        self._process, self._output = process, output
        self._ended: asyncio.Future[int] = asyncio.get_running_loop().create_future()
        self._processor_s: float | None = None
        threading.Thread(target=self._reap, args=(self._ended.get_loop(),), daemon=True).start()

    @classmethod
    async def start(
        cls, command: Sequence[str], folder: Path, log: Path, variables: Mapping[str, str], nice: int = 0
    ) -> Child:
        """Run ``command FOLDER`` inside ``folder`` with a clean environment; appends stderr to ``log``.

        ``nice``: lowers its priority, mainly against the API's processes.
        """
        # The job reads strangers' files: it gets neither the database's address nor other settings of ours.
        inherited = {name: value for name, value in os.environ.items() if not name.startswith("BIRESNERF_")}
        # ``python -m`` would look for modules in the folder first, where a stranger's json.py may lie.
        inherited["PYTHONSAFEPATH"] = "1"
        with log.open("ab") as errors:
            process = subprocess.Popen(
                dying_with_parent([*command, str(folder)], signal_number=signal.SIGKILL, nice=nice),
                stdin=subprocess.DEVNULL,
                stdout=subprocess.PIPE,
                stderr=errors,
                cwd=folder,
                env={**inherited, **variables},
                start_new_session=True,
            )
        output = asyncio.StreamReader(limit=LINE_BYTES_MAX)
        protocol = asyncio.StreamReaderProtocol(output)
        child = cls(process, output)
        await asyncio.get_running_loop().connect_read_pipe(lambda: protocol, process.stdout)
        return child

    def _reap(self, loop: asyncio.AbstractEventLoop) -> None:
        """Wait in a thread: asyncio and `subprocess` do not report a process's resource use."""
        _, status, used = os.wait4(self.pid, 0)
        self._process.returncode = os.waitstatus_to_exitcode(status)
        self._processor_s = used.ru_utime + used.ru_stime
        with contextlib.suppress(RuntimeError):  # the loop is closed: nobody waits
            loop.call_soon_threadsafe(self._ended.set_result, self._process.returncode)

    @property
    def pid(self) -> int:
        """Process id, also the id of its process group."""
        return self._process.pid

    async def lines(self) -> AsyncIterator[bytes]:
        """Lines of standard output until it closes; one longer than a mebibyte is dropped."""
        while True:
            try:
                line = await self._output.readline()
            except ValueError:
                continue
            if not line:
                return
            yield line

    async def wait(self) -> int:
        """The exit status (negative: killed by that signal); kills its descendants as well."""
        status = await asyncio.shield(self._ended)
        self.kill()
        return status

    async def stop(self, grace_s: float) -> None:
        """Ask it to write a checkpoint and exit; kill it after ``grace_s``."""
        with contextlib.suppress(ProcessLookupError):
            os.killpg(self.pid, signal.SIGTERM)
        await asyncio.wait({self._ended}, timeout=grace_s)
        if not self._ended.done():
            self.kill()

    def kill(self) -> None:
        """Kill the process and all it started."""
        with contextlib.suppress(ProcessLookupError):
            os.killpg(self.pid, signal.SIGKILL)

    def processor_s(self) -> float:
        """User and system seconds of the process and its descendants until now.

        While it runs, summed over its session from /proc (proc_pid_stat(5)); after its end, the kernel's count
        (wait4(2)), without descendants that it did not wait for.
        """
        if self._processor_s is not None:
            return self._processor_s
        ticks = 0
        for stat in Path("/proc").glob("[0-9]*/stat"):
            with contextlib.suppress(OSError):
                # Fields from the third on; the name before them may hold anything.
                values = stat.read_bytes().rpartition(b")")[2].split()
                if int(values[3]) == self.pid:
                    ticks += sum(map(int, values[11:15]))
        return ticks / _TICKS_PER_S


def log_tail(log: Path) -> str:
    """The end of a log file, fit for an error message."""
    if not log.exists():
        return ""
    with log.open("rb") as file:
        file.seek(max(0, log.stat().st_size - TAIL_BYTES))
        # The database stores no NUL in text.
        return file.read().decode(errors="replace").replace("\0", "\ufffd").strip()
