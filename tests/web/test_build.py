"""The built page loads nothing from outside, and is up to date with its sources."""

from __future__ import annotations

import re
from pathlib import Path

import pytest

import hatch_build

ROOT = Path(__file__).resolve().parents[2]
BUILT = [
    path
    for folder in hatch_build.SOURCES
    for path in sorted((ROOT / folder / "dist").glob("*"))
    if path.suffix in {".js", ".css", ".html", ".svg"}
]
# Names, not addresses: nothing is fetched from them.
NAMESPACES = {
    "http://www.w3.org/1999/xhtml",
    "http://www.w3.org/2000/svg",
    "http://www.w3.org/1998/Math/MathML",
    "http://www.w3.org/1999/xlink",
    "http://www.w3.org/XML/1998/namespace",
}

if not BUILT:
    pytest.skip("The page is not built; make web builds it.", allow_module_level=True)


def urls(text: str) -> set[str]:
    return {match.rstrip(".,;:)") for match in re.findall(r"(?:https?|wss?)://[^\s\"'`\\<>]+", text)}


@pytest.mark.parametrize("path", BUILT, ids=lambda path: path.name)
def test_no_address_outside_is_in_the_build(path: Path) -> None:
    assert urls(path.read_text()) - NAMESPACES == set()


def test_an_address_would_be_found() -> None:
    assert urls('x="https://cdn.example/a.js";y=`//b`') == {"https://cdn.example/a.js"}


def test_the_build_is_of_these_sources() -> None:
    assert hatch_build.is_built(ROOT), "make web builds it anew"


def test_the_page_reads_only_what_responses_and_result_files_hold() -> None:
    if not (ROOT / "node_modules" / "typescript").is_dir():
        pytest.skip("TypeScript is not installed; make web installs it.")
    assert hatch_build.check_types(ROOT) == 0


def test_the_lock_file_names_no_registry_and_a_digest_for_each_package() -> None:
    text = (ROOT / "package-lock.json").read_text()
    assert '"resolved"' not in text
    packages = text.count("/node_modules/") + text.count('"node_modules/')
    assert text.count('"integrity": "sha512-') == packages
