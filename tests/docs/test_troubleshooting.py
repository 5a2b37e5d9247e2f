"""The troubleshooting page names every error that users can meet, and none that no longer exists."""

from __future__ import annotations

import re
from typing import get_args

from biresnerf.options.refine_options import RefineOptions
from biresnerf.report import VerdictName
from tests.docs.codes import codes_in_use
from tests.docs.documented import ROOT

PAGE = (ROOT / "docs/troubleshooting.md").read_text("utf-8")
NAMED = set(re.findall(r"`([a-z0-9_]+)`", PAGE))
SOURCES = "\n".join(path.read_text("utf-8") for path in sorted((ROOT / "biresnerf").rglob("*.py")))


def test_every_code_of_an_error_is_on_the_page():
    codes = codes_in_use()
    assert len(codes) > 140
    assert {code: place for code, place in codes.items() if code not in NAMED} == {}


def test_the_page_names_no_code_that_is_gone():
    rows = re.findall(r"^\|(?: \d*;? ?\|)? ((?:`[a-z0-9_]+`(?:, )?)+) \|", PAGE, flags=re.M)
    named = {code for row in rows for code in re.findall(r"`(\w+)`", row)}
    assert len(named) > 100
    assert named <= set(codes_in_use()) | {"pg_dump_failed", "pg_restore_failed"}


def test_every_verdict_and_only_options_that_exist():
    assert set(get_args(VerdictName)) - {"improved"} <= NAMED
    set_to = set(re.findall(r"`(?:--set )?([a-z_]+)=[\w.]+`", PAGE))
    assert set_to
    assert set_to <= set(RefineOptions.model_fields)


def test_every_warning_that_is_quoted_is_one_that_is_given():
    section = PAGE[PAGE.index("## Warnings of a result") : PAGE.index("## The input is refused")]
    quoted = [
        text
        for row in re.findall(r"^\| (`.*?) \|", section, flags=re.M)
        for text in re.findall(r"`([^`]+)`", row)
    ]
    assert len(quoted) > 12
    # A message may be broken over two lines of the source.
    joined = re.sub(r'"\s*\n\s*f?"', "", SOURCES)
    assert [text for text in quoted if text not in joined] == []
