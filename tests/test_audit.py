"""The audit of the CI fails on a known fault, and on nothing else. Its input has the form of pip-audit's answers."""

from __future__ import annotations

import json
import subprocess
import sys
from pathlib import Path

import pytest

AUDIT = Path(__file__).parents[1] / ".ci/audit.py"
CLEAN = {"name": "numpy", "version": "2.3.0", "vulns": []}
SKIPPED = {
    "name": "torch",
    "skip_reason": "Dependency not found on PyPI and could not be audited: torch (2.13.0)",
}
FAULTY = {
    **{"name": "jinja2", "version": "2.4.1"},
    "vulns": [{"id": "PYSEC-2014-8", "fix_versions": ["2.7.2"], "aliases": [], "description": "…"}],
}


def audited(tmp_path: Path, said: str) -> subprocess.CompletedProcess[str]:
    program = tmp_path / "bin/pip-audit"
    program.parent.mkdir()
    program.write_text(f"#!{sys.executable}\nprint({said!r})\n")
    program.chmod(0o755)
    return subprocess.run([sys.executable, AUDIT, tmp_path], capture_output=True, text=True)


@pytest.mark.parametrize(
    ("libraries", "status", "told"),
    [
        ([CLEAN], 0, "1 libraries looked up, 0 with a known fault"),
        ([CLEAN, SKIPPED], 0, "skipped: the index has no advisories of torch\n"),
        ([SKIPPED], 0, "skipped: the index has no advisories of any library\n"),
        ([CLEAN, SKIPPED, FAULTY], 1, "jinja2 2.4.1: PYSEC-2014-8, mended in 2.7.2\n"),
    ],
)
def test_only_a_known_fault_fails_and_what_is_skipped_is_named(
    tmp_path: Path, libraries: list[dict[str, object]], status: int, told: str
):
    done = audited(tmp_path, json.dumps({"dependencies": libraries, "fixes": []}))
    assert (done.returncode, done.stderr) == (status, "")
    assert told in done.stdout


def test_without_network_or_tools_it_is_skipped(tmp_path: Path):
    assert audited(tmp_path, "").returncode == 0
    absent = subprocess.run([sys.executable, AUDIT, tmp_path / "absent"], capture_output=True, text=True)
    assert (absent.returncode, absent.stdout) == (
        0,
        "skipped: the advisories cannot be reached (FileNotFoundError)\n",
    )
