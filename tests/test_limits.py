"""The project's limits, which keep every file readable at once; docs/architecture.md gives the reasons."""

from __future__ import annotations

import ast
from collections import defaultdict
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[1]
FILE_LINES, FUNCTION_LINES, ENTRIES, SMALL_LINES = 400, 60, 14, 60
# A command, and the routes of a resource, have a module each; kernels are compiled and cached by module.
ALONE = (
    "biresnerf/commands/",
    "service/routes/",
    "biresnerf/refinement/kernels/",
    "biresnerf/refinement/adjustment/kernels/",
)
OFFCUTS = {
    "biresnerf/options/validated_options.py",  # refuses words; `refine_options` declares, and nothing else
    "biresnerf/refinement/parameters/ring_parameters.py",
}
DRAWERS = {"utils", "helpers", "common", "core", "misc"}
SOURCES = [
    path
    for top in ("biresnerf", "workers", "service", "tests", "benchmarks", "docs", "examples")
    for pattern in ("*.py", "*.ts", "*.tsx", "*.css")
    for path in sorted((ROOT / top).rglob(pattern))
    if not {"dist", "node_modules"} & set(path.parts)
]
PYTHON = [path for path in SOURCES if path.suffix == ".py"]


def _name(path: Path) -> str:
    return str(path.relative_to(ROOT))


def _lines_of_body(function: ast.FunctionDef | ast.AsyncFunctionDef) -> int:
    """Lines below the signature and the docstring, which say what a caller must know and may be long."""
    body = function.body[1:] if ast.get_docstring(function) and len(function.body) > 1 else function.body
    return (body[-1].end_lineno or 0) - body[0].lineno + 1


def test_no_file_is_too_long_to_read_at_once():
    lengths = {_name(path): len(path.read_text().splitlines()) for path in SOURCES}
    assert {name: lines for name, lines in lengths.items() if lines > FILE_LINES} == {}


def test_no_function_is_too_long_to_see_at_once():
    long = [
        (_name(path), node.name, _lines_of_body(node))
        for path in PYTHON
        for node in ast.walk(ast.parse(path.read_text()))
        if isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef) and _lines_of_body(node) > FUNCTION_LINES
    ]
    assert long == []


def test_no_module_is_a_drawer():
    assert [_name(path) for path in PYTHON if path.stem in DRAWERS] == []


def test_no_room_is_too_full():
    rooms: dict[str, int] = defaultdict(int)
    for path in SOURCES:
        if path.name != "__init__.py" and path.relative_to(ROOT).parts[0] != "tests":
            rooms[_name(path.parent)] += 1
    assert {room: files for room, files in rooms.items() if files > ENTRIES} == {}


@pytest.mark.parametrize("package", ["biresnerf", "workers", "service"])
def test_every_room_says_what_lives_in_it(package: str):
    rooms = list((ROOT / package).rglob("__init__.py"))
    assert [_name(path) for path in rooms if not ast.get_docstring(ast.parse(path.read_text()))] == []


def _imported(path: Path) -> set[str]:
    """Modules that a file imports, by their dotted names; names out of modules among them."""
    names = set()
    for node in ast.walk(ast.parse(path.read_text())):
        if isinstance(node, ast.ImportFrom) and node.module:
            names |= {node.module, *(f"{node.module}.{alias.name}" for alias in node.names)}
        elif isinstance(node, ast.Import):
            names |= {alias.name for alias in node.names}
    return names


def test_no_small_module_is_an_offcut_of_its_one_importer():
    product = [path for path in PYTHON if _name(path).startswith(("biresnerf/", "workers/", "service/"))]
    importers: dict[str, int] = defaultdict(int)
    for path in product:
        for name in _imported(path):
            importers[name] += 1
    small = [
        _name(path)
        for path in product
        if len(path.read_text().splitlines()) < SMALL_LINES and not path.name.startswith("__")
    ]
    offcuts = [name for name in small if importers[name.removesuffix(".py").replace("/", ".")] == 1]
    assert [name for name in offcuts if not name.startswith(ALONE) and name not in OFFCUTS] == []
