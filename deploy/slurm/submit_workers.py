#!/usr/bin/env python3
"""Submits one-job workers to Slurm for the jobs that wait; see docs/slurm.md.

    submit_workers.py --most 20 [--kind gpu] [--every 30] [-- OPTIONS OF SBATCH]

Needs `squeue`, `sbatch` and psycopg; runs as the user who is to own the workers. BIRESNERF_QUEUE_URL holds the
database's address, or BIRESNERF_QUEUE_URL_FILE names a file with it; a role that may read the view queue_depth
suffices. Without --every it runs once, for cron and scrontab. Exit status 0: what was needed is submitted.
"""

from __future__ import annotations

import argparse
import os
import subprocess
import sys
import time
from collections import Counter
from dataclasses import dataclass
from pathlib import Path

import psycopg

WORKER = Path(__file__).with_name("worker.sh")
# Without a lock, two concurrent runs would each submit all workers.
LOCK = 7_201_608
ANSWER_S = 60.0
ARRAY_MOST = 1000  # Slurm's default for MaxArraySize is 1001
RUNS = {"RUNNING", "SUSPENDED", "STOPPED", "RESIZING", "SIGNALING"}
IS_OVER = {"COMPLETING", "STAGE_OUT"}


@dataclass(frozen=True)
class Workers:
    """Slurm's workers of one kind: those that wait for an allocation, and those that run."""

    pending: int
    running: int


def workers_in(states: Counter[str]) -> Workers:
    """The workers by the counts of Slurm's states; ending workers do not count, as they take no more jobs."""
    running = sum(number for state, number in states.items() if state in RUNS)
    over = sum(number for state, number in states.items() if state in IS_OVER)
    return Workers(states.total() - running - over, running)


def wanted(waiting: int, busy: int, workers: Workers, most: int) -> int:
    """How many workers to submit.

    Args:
        waiting: jobs that another worker would get.
        busy: jobs that run on workers of this kind. Other running workers have just started and will take one each.
        most: maximum number of workers, waiting for an allocation or running.
    """
    idle = max(0, workers.running - busy)
    lacking = waiting - workers.pending - idle
    return max(0, min(lacking, most - workers.pending - workers.running, ARRAY_MOST))


def database_url() -> str:
    """The address from the environment, or the file it names; raises `SystemExit`."""
    if file := os.environ.get("BIRESNERF_QUEUE_URL_FILE"):
        return Path(file).read_text().strip()
    if url := os.environ.get("BIRESNERF_QUEUE_URL"):
        return url
    raise SystemExit("Set BIRESNERF_QUEUE_URL, or BIRESNERF_QUEUE_URL_FILE.")


def seen_by_slurm(name: str) -> Workers:
    """Our workers of this name; raises `subprocess.SubprocessError` if Slurm does not answer."""
    command = ["squeue", "--me", "--noheader", "--array", f"--name={name}", "--format=%T"]
    answer = subprocess.run(command, capture_output=True, text=True, check=True, timeout=ANSWER_S)
    return workers_in(Counter(answer.stdout.split()))


def submit(number: int, name: str, kind: str, more: list[str]) -> None:
    """Submit one array; raises `subprocess.SubprocessError`. Workers get our environment without our database role."""
    environment = {
        key: value for key, value in os.environ.items() if not key.startswith("BIRESNERF_QUEUE_URL")
    }
    command = ["sbatch", "--parsable", f"--job-name={name}", f"--array=1-{number}", *more, str(WORKER), kind]
    subprocess.run(command, capture_output=True, text=True, check=True, timeout=ANSWER_S, env=environment)


def look(url: str, name: str, kind: str, most: int, more: list[str]) -> str:
    """Run one round; returns what was found and done."""
    with psycopg.connect(url, autocommit=True, connect_timeout=int(ANSWER_S)) as connection:
        connection.execute("SELECT pg_advisory_lock(%s)", (LOCK,))
        # Ask Slurm first: a job taken between the two queries then counts as running, not twice as waiting.
        workers = seen_by_slurm(name)
        row = connection.execute(
            "SELECT waiting, running FROM queue_depth WHERE slot_kind = %s", (kind,)
        ).fetchone()
        assert row is not None, "the view has a row for each kind"
        number = wanted(*row, workers, most)
        if number:
            submit(number, name, kind, more)
    jobs, fleet = (
        f"{row[0]} jobs wait, {row[1]} run",
        f"{workers.pending} workers wait, {workers.running} run",
    )
    return f"{jobs}; {fleet}; {number} submitted"


def trouble(error: Exception) -> str:
    """The error in one or a few lines."""
    said = error.stderr if isinstance(error, subprocess.CalledProcessError) else ""
    return f"{error} {said}".strip()


def main() -> int:
    """Run rounds; returns the exit status of the last one."""
    parser = argparse.ArgumentParser(description="Submit as many one-job workers to Slurm as jobs wait for.")
    parser.add_argument("--most", type=int, required=True, help="Workers at a time, waiting and running.")
    parser.add_argument("--kind", choices=("cpu", "gpu"), default="cpu")
    parser.add_argument("--name", help="Of the Slurm jobs. Default: biresnerf-cpu or biresnerf-gpu.")
    parser.add_argument("--every", type=float, metavar="SECONDS", help="Look again and again.")
    parser.add_argument(
        "sbatch", nargs="*", metavar="-- OPTION", help="Options for sbatch: partition, account, GPU."
    )
    asked = parser.parse_args()
    url, name = database_url(), asked.name or f"biresnerf-{asked.kind}"
    while True:
        try:
            sys.stdout.write(look(url, name, asked.kind, asked.most, asked.sbatch) + "\n")
            status = 0
        except (psycopg.Error, subprocess.SubprocessError, OSError) as error:
            # Nothing is submitted unless both have answered: jobs wait until the next round.
            sys.stderr.write(f"nothing can be submitted now: {trouble(error)}\n")
            status = 1
        sys.stdout.flush()
        if asked.every is None:
            return status
        time.sleep(asked.every)


if __name__ == "__main__":
    sys.exit(main())
