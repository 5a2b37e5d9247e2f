"""Plain English in what users read: nothing from the list in prose.toml, and pages no longer than it says."""

from __future__ import annotations

import ast
import re
import tomllib
from collections.abc import Iterator
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]
LIST = tomllib.loads((ROOT / "tests/prose.toml").read_text())
GENERATED = {"commands.md", "options.md", "settings.md"}
TABLES = re.compile(r"written by `make docs`.*?<!-- end -->", re.DOTALL)  # those of a format, say
GUIDE, FRONT = "guide.md", {"README.md", "quick-start.md", "guide.md"}
PAGES = [
    *(ROOT / name for name in ("README.md", "SECURITY.md", "CONTRIBUTING.md")),
    *(path for path in sorted((ROOT / "docs").glob("*.md")) if path.name not in GENERATED),
    *sorted((ROOT / "examples").glob("*.md")),
]
# Texts of the page: what stands between tags, and quoted strings with a space.
TEXTS = re.compile(r">([^<>{}]*[a-z] [^<>{}]*)<|\"([^\"\n]*[a-z] [^\"\n]*)\"|`([^`\n]*[a-z] [^`\n]*)`")


def prose_of_pages() -> Iterator[tuple[str, str]]:
    for path in PAGES:
        text = re.sub(r"```.*?```|`[^`\n]*`", "", path.read_text("utf-8"), flags=re.DOTALL)
        yield path.relative_to(ROOT).as_posix(), text


def prose_of_the_web_page() -> Iterator[tuple[str, str]]:
    for folder in ("service/web", "biresnerf/viewer"):
        for path in sorted((ROOT / folder).rglob("*.ts*")):
            if "dist" not in path.parts:
                found = TEXTS.findall(re.sub(r"^\s*(//|\*|/\*).*", "", path.read_text("utf-8"), flags=re.M))
                yield path.relative_to(ROOT).as_posix(), "\n".join("".join(parts) for parts in found)


def first_lines_of_modules() -> Iterator[tuple[str, str]]:
    for folder in ("biresnerf", "service", "workers"):
        for path in sorted((ROOT / folder).rglob("*.py")):
            docstring = ast.get_docstring(ast.parse(path.read_text("utf-8"))) or ""
            yield path.relative_to(ROOT).as_posix(), docstring.split("\n\n")[0]


def test_no_turn_of_phrase_reads_as_translated():
    found = [
        f"{name}: “{match.group()}”, better: {instead}"
        for prose in (prose_of_pages(), prose_of_the_web_page(), first_lines_of_modules())
        for name, text in prose
        for pattern, instead in LIST["better"].items()
        for match in re.finditer(pattern, text, re.IGNORECASE)
    ]
    assert found == []


def test_pages_are_no_longer_than_they_may_be():
    written = {
        path.name: TABLES.sub("", path.read_text("utf-8")) for path in PAGES if path.parent.name == "docs"
    }
    words = {name: len(text.split()) for name, text in written.items()}
    assert words[GUIDE] <= LIST["most_words_guide"]
    assert sum(n for name, n in words.items() if name not in FRONT) <= LIST["most_words_internals"]


def test_the_list_finds_what_it_names():
    texts = {
        "told apart": "They are told apart by keys.",
        "mend": "how to mend it",
        "of (its": "has lenses of its own",
    }
    for part, text in texts.items():
        pattern = next(each for each in LIST["better"] if part in each)
        assert re.search(pattern, text, re.IGNORECASE)
