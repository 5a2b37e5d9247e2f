"""`biresnerf doctor` on this machine, and on one whose database is not there."""

from __future__ import annotations

import json

import pytest
from click.testing import CliRunner

from biresnerf.commands.machine.doctor import doctor_command
from service.commands.doctor_checks import database, page
from service.web_page import FOLDER
from tests.service.free_port import free_port

pytestmark = pytest.mark.server


def test_everything_that_tests_use_is_found_good() -> None:
    result = CliRunner().invoke(doctor_command, ["--json"], env={"BIRESNERF_DATABASE_URL": None})
    found = json.loads(result.stdout)
    states = {check["name"]: check["state"] for check in found["checks"]}
    for name in ("versions", "processor", "kernels", "video", "work files", "database", "service disk"):
        assert states[name] == "good", found
    assert found["good"] is ("broken" not in states.values())
    assert all(check["hint"] for check in found["checks"] if check["state"] != "good")


def test_a_database_that_does_not_answer_is_broken_and_said_so(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("BIRESNERF_DATABASE_URL", f"postgresql://nobody@127.0.0.1:{free_port()}/none")
    found = database()
    assert found.state == "broken"
    assert "refused" in found.detail


def test_the_page_is_good_where_it_is_built() -> None:
    assert (page().state == "good") is (FOLDER / "index.html").is_file()
