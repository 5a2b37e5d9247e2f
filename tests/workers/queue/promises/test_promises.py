"""The queue keeps its promises whatever happens in between: see docs/reliability.md.

Hypothesis chooses who does what next, at which statement a connection is cut or a process dies, and where one call
waits within its transaction while another one runs. After each step the database must be where the model allows, and
no promise may be broken. A run here has few interleavings, and the written ones; `make promises` has
thousands.
"""

from __future__ import annotations

import os
from pathlib import Path

from hypothesis import HealthCheck, Phase, settings
from hypothesis.stateful import run_state_machine_as_test

from tests.workers.queue.promises.machine import promises_on

INTERLEAVINGS = int(os.environ.get("BIRESNERF_TEST_INTERLEAVINGS", "0"))
# Without shrinking, which tries the whole storm again for minutes: the steps are few enough to read.
PHASES = [Phase.generate]


def test_no_interleaving_breaks_a_promise(database_url: str, tmp_path: Path):
    few = settings(max_examples=10, stateful_step_count=50, derandomize=True, database=None)
    chosen = settings(max_examples=INTERLEAVINGS, stateful_step_count=50) if INTERLEAVINGS else few
    with promises_on(database_url, tmp_path) as promises:
        run_state_machine_as_test(
            promises,
            settings=settings(
                chosen,
                deadline=None,
                suppress_health_check=list(HealthCheck),
                report_multiple_bugs=False,
                phases=PHASES,
            ),
        )
        counts = promises.counts
    print(counts)  # noqa: T201
    assert counts["examples"] >= 10
    assert (
        min(
            counts.get(kind, 0)
            for kind in ("calls that lost a connection", "processes that died within a call")
        )
        > 10
    )
