"""The queue keeps its promises whatever happens in between: see docs/reliability.md.

Hypothesis chooses who does what next, at which statement a connection is cut or a process dies, and where one call
waits within its transaction while another one runs. After each step the database must be where the model allows, and
no promise may be broken. A run here has few interleavings, and the written ones; `make promises` has
thousands. Each run has others; a failure prints the seed that repeats them.
"""

from __future__ import annotations

import os
import random
from pathlib import Path

from hypothesis import HealthCheck, Phase, seed, settings
from hypothesis.stateful import run_state_machine_as_test

from tests.workers.queue.promises.machine import promises_on

INTERLEAVINGS = int(os.environ.get("BIRESNERF_TEST_INTERLEAVINGS", "0"))
SEED = int(os.environ.get("BIRESNERF_TEST_SEED") or random.randrange(2**32))
# Without shrinking, which tries the whole storm again for minutes: the steps are few enough to read.
PHASES = [Phase.generate]


# Hypothesis leaves kinds of steps out of an example by chance, so ten may lack one: others follow.
FAULTS, ENOUGH, ROUNDS_MOST = ("calls that lost a connection", "processes that died within a call"), 10, 10


def test_no_interleaving_breaks_a_promise(database_url: str, tmp_path: Path):
    print(f"BIRESNERF_TEST_SEED={SEED}")  # noqa: T201
    with promises_on(database_url, tmp_path) as promises:
        counts = promises.counts
        for number in range(ROUNDS_MOST):
            run_state_machine_as_test(
                seed(SEED + number)(promises),
                settings=settings(
                    max_examples=INTERLEAVINGS or 10,
                    stateful_step_count=50,
                    database=None,
                    deadline=None,
                    suppress_health_check=list(HealthCheck),
                    report_multiple_bugs=False,
                    phases=PHASES,
                ),
            )
            if min(counts.get(kind, 0) for kind in FAULTS) > ENOUGH:
                break
    print(counts)  # noqa: T201
    assert counts["examples"] >= 10
    assert min(counts.get(kind, 0) for kind in FAULTS) > ENOUGH
