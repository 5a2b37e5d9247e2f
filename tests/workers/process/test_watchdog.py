"""A process whose event loop stands still ends; one that was only frozen goes on."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import time
from pathlib import Path

from tests.workers.conftest import ROOT
from workers.process.exit_status import ExitStatus

PROGRAM = """
import asyncio, sys, time
from pathlib import Path
from workers.process.watchdog import end_if_hung

async def main():
    async with end_if_hung(1.0, Path(sys.argv[2])):
        print("ready", flush=True)
        if sys.argv[1] == "hangs":
            time.sleep(60)
        await asyncio.sleep(4)

asyncio.run(main())
"""


def start(how: str, beat: Path) -> subprocess.Popen[str]:
    process = subprocess.Popen(
        [sys.executable, "-c", PROGRAM, how, str(beat)],
        cwd=ROOT,
        text=True,
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
    )
    assert process.stdout is not None
    assert process.stdout.readline() == "ready\n"
    return process


def test_a_loop_that_stands_still_ends_the_process_and_says_where(tmp_path: Path):
    process = start("hangs", tmp_path / "beat")
    _, said = process.communicate(timeout=40)
    assert process.returncode == ExitStatus.STUCK
    assert "in main" in said


def test_a_process_that_was_frozen_goes_on(tmp_path: Path):
    beat = tmp_path / "beats/of-it"
    process = start("works", beat)
    until = time.monotonic() + 30
    while not beat.exists() and time.monotonic() < until:
        time.sleep(0.01)
    os.kill(process.pid, signal.SIGSTOP)
    frozen = beat.stat().st_mtime
    time.sleep(2.5)
    assert beat.stat().st_mtime == frozen
    os.kill(process.pid, signal.SIGCONT)
    process.communicate(timeout=40)
    assert process.returncode == 0
    assert beat.stat().st_mtime > frozen + 2.0, "it shows whoever looks from outside that it goes on"
