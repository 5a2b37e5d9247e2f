"""How many workers deploy/slurm/submit_workers.py submits; test_slurm.py runs it against a real cluster."""

from __future__ import annotations

import os
import re
import subprocess
import sys
from collections import Counter

import psycopg
import pytest

from tests.deploy.manifests import ROOT
from tests.deploy.slurm_submission import SUBMIT, submission
from tests.workers.conftest import Counting

program = submission()
Workers = program.Workers


@pytest.mark.parametrize(
    ("waiting", "busy", "workers", "most", "expected"),
    [
        (20, 0, Workers(0, 0), 6, 6),  # no more than there may be
        (20, 0, Workers(6, 0), 6, 0),
        (3, 0, Workers(0, 0), 6, 3),
        (3, 0, Workers(3, 0), 6, 0),  # each has a worker that waits for its allocation
        (3, 0, Workers(1, 2), 6, 0),  # or one that has started and holds no job yet
        (3, 2, Workers(1, 2), 9, 2),
        (3, 5, Workers(0, 2), 9, 3),  # jobs run on other workers, too
        (0, 4, Workers(0, 4), 9, 0),
        (5, 4, Workers(0, 4), 6, 2),
        (5, 9, Workers(0, 9), 6, 0),  # the limit was lowered
        (5000, 0, Workers(0, 0), 4000, 1000),  # the largest array
    ],
)
def test_as_many_as_wait_less_those_on_their_way(waiting, busy, workers, most, expected):
    assert program.wanted(waiting, busy, workers, most) == expected


def test_states_of_slurm_are_workers_that_wait_or_run():
    states = Counter({"PENDING": 3, "CONFIGURING": 1, "RUNNING": 2, "SUSPENDED": 1, "COMPLETING": 5})
    assert program.workers_in(states) == Workers(pending=4, running=3)


@pytest.mark.anyio
async def test_nothing_is_submitted_while_slurm_does_not_answer(
    counting: Counting, scaler: psycopg.Connection, tmp_path
):
    await counting.submit(1, 0.01)
    for name, text in (("squeue", "echo no controller >&2; exit 1"), ("sbatch", f"touch {tmp_path}/called")):
        (tmp_path / name).write_text(f"#!/bin/sh\n{text}\n")
        (tmp_path / name).chmod(0o755)
    url = f"{scaler.info.dsn}"
    said = run_once(url, f"{tmp_path}:{os.environ['PATH']}")
    assert said.returncode == 1
    assert "no controller" in said.stderr
    assert not (tmp_path / "called").exists()


def test_nothing_is_submitted_while_the_database_does_not_answer(tmp_path):
    said = run_once("postgresql:///nobody?host=/nowhere", os.environ["PATH"])
    assert said.returncode == 1
    assert "nothing can be submitted now" in said.stderr


def run_once(url: str, path: str) -> subprocess.CompletedProcess[str]:
    return subprocess.run(
        [sys.executable, str(SUBMIT), "--most", "3"],
        env={**os.environ, "BIRESNERF_QUEUE_URL": url, "PATH": path},
        capture_output=True, text=True, timeout=60, check=False,
    )  # fmt: skip


def test_the_workers_script_is_what_bash_reads_and_the_worker_knows():
    script = ROOT / "deploy/slurm/worker.sh"
    assert subprocess.run(["bash", "-n", str(script)], check=False).returncode == 0
    said = subprocess.run(
        [sys.executable, "-m", "biresnerf.command_line", "worker", "--help"],
        capture_output=True, text=True, check=True,
    )  # fmt: skip
    for option in re.findall(r" (--[a-z-]+)", script.read_text().rpartition("exec ")[2]):
        assert option in said.stdout
