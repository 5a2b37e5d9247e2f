"""The shell and Python lines that the page shows beside a download, run as they are."""

from __future__ import annotations

import hashlib
import shlex
import subprocess
import sys
from pathlib import Path

from playwright.sync_api import Page


def expect_lines_to_bring_the_same(page: Page, digests: dict[str, str], tmp_path: Path) -> None:
    """Run in ``tmp_path``, they bring the files with these digests by name."""
    row = page.get_by_role("listitem").filter(has_text="For COLMAP").first
    row.get_by_role("button", name="curl, Python").click()
    python = row.get_by_label("Python", exact=True).inner_text()
    subprocess.run([sys.executable, "-c", python], cwd=tmp_path, check=True)
    brought = tmp_path / "result"
    found = {
        path.relative_to(brought).as_posix(): hashlib.sha256(path.read_bytes()).hexdigest()
        for path in brought.rglob("*")
        if path.is_file()
    }
    assert found == {name: sha for name, sha in digests.items() if name.startswith("colmap/sparse/")}
    row = page.get_by_role("listitem").filter(has_text="For nerfstudio")
    row.get_by_role("button", name="curl, Python").click()
    curl = row.get_by_label("curl", exact=True).inner_text()
    subprocess.run(shlex.split(curl), cwd=tmp_path, check=True, capture_output=True)
    sent = (tmp_path / "transforms_nerfstudio.json").read_bytes()
    assert hashlib.sha256(sent).hexdigest() == digests["transforms_nerfstudio.json"]
