"""A short fuzzing of the whole interface; `make fuzz` is the long one."""

from __future__ import annotations

import pytest

from tests.service.fuzzing import fuzzed, mutated


@pytest.mark.server
def test_made_up_requests_get_no_server_error_and_no_undeclared_answer() -> None:
    few = ("--phases", "examples,fuzzing,stateful", "--max-examples", "1")
    done, log = fuzzed(*few, "--generation-deterministic", "--no-color")
    assert done.returncode == 0, f"{log}\n{done.stdout}"
    assert "Traceback" not in log
    for phase in ("Examples", "Fuzzing", "Stateful"):
        assert f"✅ {phase}" in done.stdout, done.stdout


@pytest.mark.server
def test_requests_with_hostile_values_get_no_server_error_and_are_told_no_path_of_the_server() -> None:
    seen, log = mutated(250, 60.0, seed=1)
    assert seen.broken == []
    assert "Traceback" not in log
    assert seen.sent == 250
    assert len(seen.operations) > 40
    assert {200, 201, 400, 404, 422} <= seen.statuses.keys(), "they reach beyond the first check"
