"""What programs that read strangers' files can see and use."""

from __future__ import annotations

import asyncio
from typing import Any

import pytest

from biresnerf.frozen_model import FrozenModel
from service.http.problems import ProblemError
from service.intake.sandboxed_child import Limits, run_confined
from tests.workers.conftest import ROOT

MEMORY = 2**30


class Asked(FrozenModel):
    """What the child does."""

    does: str = ""


@pytest.fixture(autouse=True)
def found_and_with_a_secret(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("PYTHONPATH", str(ROOT))
    monkeypatch.setenv("BIRESNERF_DATABASE_URL", "postgresql://user:secret@host/database")


def told(does: str = "", seconds: float = 60.0) -> dict[str, Any]:
    limits = Limits(seconds=seconds, memory_bytes=MEMORY, file_bytes=2**20)
    return asyncio.run(run_confined("tests.service.intake.confined_child", Asked(does=does), limits))


def test_a_child_gets_no_secret_and_has_its_limits():
    found = told()
    assert "PYTHONPATH" in found["variables"]
    assert [name for name in found["variables"] if name.startswith("BIRESNERF_")] == []
    assert found["limits"] == {"RLIMIT_AS": MEMORY, "RLIMIT_FSIZE": 2**20}


def test_a_child_that_does_not_end_is_ended():
    with pytest.raises(ProblemError) as caught:
        told("wait", seconds=0.2)
    assert caught.value.code == "validation_timeout"
