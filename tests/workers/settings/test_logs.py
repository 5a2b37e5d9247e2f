from __future__ import annotations

import json
import os
import subprocess
import sys

import pytest

HOSTILE = "a\nfake line\r\x1b[2J\u2028\u202e\x00\ud800"
PROGRAM = f"""
import asyncio, logging
from workers.settings.logs import log_context, set_up_logging
from workers.settings.settings import Settings

set_up_logging("api", Settings())
log = logging.getLogger("test")
log.info("said %s", {HOSTILE!r})
with log_context(request_id="r1", job_id=None):
    log.info("within", extra={{"fields": {{"route": {HOSTILE!r}}}}})

    async def task():
        log.warning("in a task")
    asyncio.run(task())
log.info("after")
try:
    raise ValueError({HOSTILE!r})
except ValueError:
    log.exception("caught")
for secret in (
    "postgresql://me:hunter2secret@host/db", "Authorization: Bearer abcdef123456",
    "whsec_C2FVsBQIhrscChlQIMV+b5sSYspob7oD",
    "https://s3/x?X-Amz-Credential=AKIAIOSFODNN7&X-Amz-Signature=fe5f80f77d5fa3beca038a248ff027",
    "a share-key-of-ours", "token=scrape-me-not",
    "the scrape-me-not itself", "the hunter2secret itself",
):
    log.info("%s", secret)
log.debug("too quiet")
raise RuntimeError({HOSTILE!r})
"""


def said(form: str) -> list[str]:
    """The lines of a process of its own, which ends by an error."""
    settings = {
        "BIRESNERF_LOG_FORMAT": form,
        "BIRESNERF_DATABASE_URL": "postgresql://me:hunter2secret@host/db",
        "BIRESNERF_METRICS_TOKEN": "scrape-me-not",
        "BIRESNERF_SHARE_KEY": "share-key-of-ours",
    }
    done = subprocess.run(
        [sys.executable, "-c", PROGRAM], env={**os.environ, **settings}, capture_output=True
    )
    assert done.returncode == 1
    text = done.stderr.decode()
    # Not str.splitlines: only what ends a line for every reader of logs.
    return text.removesuffix("\n").split("\n")


def test_every_json_line_is_a_record_with_what_it_is_about() -> None:
    records = [json.loads(line) for line in said("json")]
    assert {record["process"] for record in records} == {"api"}
    assert records[0]["message"] == f"said {HOSTILE}"
    assert records[1]["request_id"] == "r1"
    assert records[1]["route"] == HOSTILE
    assert records[2]["request_id"] == "r1"
    assert not {"request_id", "job_id"} & set(records[3])
    assert "ValueError" in records[4]["exception"]
    assert records[-1]["level"] == "CRITICAL"
    assert "RuntimeError" in records[-1]["exception"]
    assert "too quiet" not in str(records)


def test_a_plain_line_cannot_be_forged_and_moves_no_cursor() -> None:
    lines = said("plain")
    text = "\n".join(lines)
    assert all(char == "\n" or char.isprintable() for char in text), repr(text)
    assert not [line for line in lines if line.startswith("fake")]
    # What is not a record is an indented part of the one above.
    assert {line[:2] for line in lines} == {"20", "  "}
    assert lines[1].endswith(r"within [request_id=r1 route=a\nfake line\r\x1b[2J\u2028\u202e\x00\ud800]")


@pytest.mark.parametrize("form", ["plain", "json"])
def test_no_secret_is_logged(form: str) -> None:
    text = "\n".join(said(form))
    for secret in (
        "hunter2secret",
        "abcdef123456",
        "C2FVsBQI",
        "AKIAIOS",
        "fe5f80",
        "scrape-me-not",
        "share-key",
    ):
        assert secret not in text
    assert text.count("***") >= 7
