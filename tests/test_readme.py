"""What the README says of options and files is so."""

from __future__ import annotations

import re
from pathlib import Path

import pytest

from biresnerf.config import PRESETS, RefineOptions

ROOT = Path(__file__).resolve().parents[1]
PAGES = [ROOT / "README.md", *sorted((ROOT / "docs").glob("*.md"))]


def test_the_table_of_keys_names_every_option_and_no_other():
    text = (ROOT / "README.md").read_text()
    table = text[text.index("| key | meaning") :].split("\n\n")[0]
    keys = {key for row in table.splitlines() for key in re.findall(r"`([a-z0-9_]+)`", row.split("|")[1])}
    have_flags = {"preset", "device", "seed"}
    assert keys == set(RefineOptions.model_fields) - have_flags


def test_every_preset_is_named():
    text = (ROOT / "README.md").read_text()
    row = next(line for line in text.splitlines() if line.startswith("| `--preset`"))
    assert set(PRESETS) <= set(re.findall(r"`(\w+)`", row))


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.name)
def test_links_lead_to_files_that_exist(page):
    links = re.findall(r"\]\(([^)#]+)[^)]*\)", page.read_text())
    missing = [link for link in links if "://" not in link and not (page.parent / link).exists()]
    assert missing == []


def test_every_make_target_of_the_readme_exists():
    targets = set(re.findall(r"^(\w+):", (ROOT / "Makefile").read_text(), flags=re.M))
    named = set(re.findall(r"(?:^|`)make ([a-z]+)", (ROOT / "README.md").read_text(), flags=re.M))
    assert {"demo", "test"} <= named <= targets
