"""Only one package has SQL on the table `jobs`, and five of its modules change it."""

from __future__ import annotations

import re

from tests.workers.conftest import ROOT

ROOM = "workers/jobs"
WRITERS = {"deliveries.py", "job_states.py", "job_expiry.py", "ledger.py", "result_links.py"}
NAMED = re.compile(r"\b(FROM|JOIN|INTO|UPDATE|TABLE)\s+(ONLY\s+)?jobs\b(?!\.)")
WRITTEN = re.compile(r"\b(INSERT\s+INTO|UPDATE|DELETE\s+FROM)\s+jobs\b")


def sql_of(source: str) -> str:
    """With the pieces of broken strings joined."""
    return re.sub(r'"\s*\n\s*f?"', "", source)


def test_statements_on_jobs_are_in_one_room():
    outside = [
        file.relative_to(ROOT).as_posix()
        for folder in ("biresnerf", "workers", "service")
        for file in (ROOT / folder).rglob("*.py")
        if NAMED.search(sql_of(file.read_text())) and file.parent != ROOT / ROOM
    ]
    assert outside == []


def test_five_modules_of_the_room_write():
    writers = {file.name for file in (ROOT / ROOM).glob("*.py") if WRITTEN.search(sql_of(file.read_text()))}
    assert writers == WRITERS
