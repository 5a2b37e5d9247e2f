"""What `make test-lowest` installs: the lowest version of each dependency that pyproject.toml allows."""

from __future__ import annotations

import re
import shutil
import subprocess
import sys

from tests.test_readme import ROOT


def test_the_lowest_versions_are_those_of_the_ranges_in_pyproject(tmp_path):
    for name in ("Makefile", "pyproject.toml"):
        shutil.copy(ROOT / name, tmp_path)
    command = ["make", "-s", "build/lowest.txt", f"PYTHON={sys.executable}"]
    done = subprocess.run(command, cwd=tmp_path, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    pins = dict(line.split("==") for line in (tmp_path / "build/lowest.txt").read_text().split())
    text = (ROOT / "pyproject.toml").read_text()
    assert pins["torch"] == re.search(r'"torch>=([\d.]+)"', text)[1]  # type: ignore[index]
    assert pins["psycopg"] == re.search(r'"psycopg\[[\w,]+\]>=([\d.]+)"', text)[1]  # type: ignore[index]
    assert "biresnerf" not in pins, "an extra that names another is no dependency of its own"
    assert len(pins) > 40
