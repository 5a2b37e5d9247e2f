"""What the README and the pages say of options and files is so."""

from __future__ import annotations

import re
from pathlib import Path

import pytest

from biresnerf.options.presets import PRESETS

ROOT = Path(__file__).resolve().parents[1]
PAGES = [
    *(ROOT / name for name in ("README.md", "SECURITY.md", "examples/README.md")),
    *sorted((ROOT / "docs").glob("*.md")),
    *sorted((ROOT / "examples").glob("[!R]*.md")),
]


def test_every_preset_is_named():
    text = (ROOT / "README.md").read_text()
    paragraph = next(part for part in text.split("\n\n") if part.startswith("`--preset`"))
    assert set(PRESETS) <= set(re.findall(r"`(\w+)`", paragraph))


def test_every_page_is_in_the_index():
    index = ROOT / "docs/README.md"
    listed = set(re.findall(r"\]\(([^)#]+)\)", index.read_text()))
    pages = [page for page in PAGES if page.parent == index.parent and page != index]
    assert [page.name for page in pages if page.name not in listed] == []


def test_the_quick_start_is_read_in_two_minutes():
    words = re.sub(r"```.*?```", "", (ROOT / "docs/quick-start.md").read_text(), flags=re.DOTALL).split()
    assert len(words) < 2 * 200  # words a minute of technical prose


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.relative_to(ROOT).as_posix())
def test_links_lead_to_files_that_exist(page):
    links = re.findall(r"\]\(([^)#]*)#?([^)]*)\)", page.read_text())
    for path, anchor in links:
        if "://" in path:
            continue
        target = page.parent / path if path else page
        assert target.exists(), path
        assert not anchor or anchor in anchors(target), f"{path}#{anchor}"


def anchors(page: Path) -> set[str]:
    """Those of its headings, as GitHub makes them."""
    headings = re.findall(r"^#+ (.+)$", page.read_text(), flags=re.M)
    plain = [re.sub(r"\[([^\]]*)\]\([^)]*\)", r"\1", heading).lower() for heading in headings]
    return {re.sub(r"[^\w\- ]", "", heading).replace(" ", "-") for heading in plain}


def test_every_make_target_of_the_readme_exists():
    targets = set(re.findall(r"^(\w+):", (ROOT / "Makefile").read_text(), flags=re.M))
    named = set(re.findall(r"(?:^|`)make ([a-z]+)", (ROOT / "README.md").read_text(), flags=re.M))
    assert {"demo", "test"} <= named <= targets
