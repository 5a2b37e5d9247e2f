"""Faults as people make them, drawn at random: another comparison, sign, bound or number in one line of the product."""

from __future__ import annotations

import ast
import random
from collections.abc import Iterator
from pathlib import Path

LARGEST_INDEX = 3  # smaller numbers are indices and axes, mostly, and their faults crash
PACKAGES = ("biresnerf", "workers", "service")
_COMPARED: dict[type[ast.cmpop], str] = {
    ast.Lt: ">", ast.LtE: ">", ast.Gt: "<", ast.GtE: "<", ast.Eq: "!=", ast.NotEq: "==", ast.In: "not in",
    ast.NotIn: "in", ast.Is: "is not", ast.IsNot: "is",
}  # fmt: skip
_COMPUTED: dict[type[ast.operator], str] = {ast.Add: "-", ast.Sub: "+", ast.Mult: "/", ast.Div: "*"}
_CALLED = {"min": "max", "max": "min", "any": "all", "all": "any", "sin": "cos", "cos": "sin"}


def drawn_faults(root: Path, chance: random.Random, count: int) -> Iterator[dict[str, str]]:
    """At most `count` faults, each in another module that has a test of its name beside it, in the folder of tests."""
    tested = [
        (path, test)
        for package in PACKAGES
        for path in sorted((root / package).rglob("*.py"))
        if (test := _test_of(root, path)).is_file()
    ]
    for path, test in chance.sample(tested, min(count, len(tested))):
        source = path.read_text()
        changes = sorted(change for change in set(_changes(source)) if _is_python(source, change))
        if changes:
            line, begin, end, text = chance.choice(changes)
            old = source.split("\n")[line]
            yield {
                "file": path.relative_to(root).as_posix(),
                "old": old,
                "new": old[:begin] + text + old[end:],
                "test": test.relative_to(root).as_posix(),
            }


def _test_of(root: Path, path: Path) -> Path:
    inside = path.relative_to(root)
    folder = Path(*inside.parts[1:-1]) if inside.parts[0] == "biresnerf" else inside.parent
    return root / "tests" / folder / f"test_{path.name}"


def _changes(source: str) -> Iterator[tuple[int, int, int, str]]:
    """Line, columns from and to, and the text in their place. Only lines that stand once can be named by their text."""
    lines = source.split("\n")
    for function in ast.walk(ast.parse(source)):
        if not isinstance(function, ast.FunctionDef | ast.AsyncFunctionDef):
            continue
        for node in (each for statement in function.body for each in ast.walk(statement)):
            change = _change(node)
            if change is None:
                continue
            around, inside = change
            begin, end = around
            line = lines[begin[0] - 1]
            if begin[0] == end[0] and line.isascii() and lines.count(line) == 1:
                yield begin[0] - 1, begin[1], end[1], inside


def _is_python(source: str, change: tuple[int, int, int, str]) -> bool:
    line, begin, end, text = change
    lines = source.split("\n")
    lines[line] = lines[line][:begin] + text + lines[line][end:]
    try:
        ast.parse("\n".join(lines))
    except SyntaxError:
        return False
    return True


_Place = tuple[int, int]


def _change(node: ast.AST) -> tuple[tuple[_Place, _Place], str] | None:
    """Where the text lies that is replaced, and what it becomes."""
    match node:
        case ast.Compare(left=left, ops=[op], comparators=[right]) if type(op) in _COMPARED:
            return (_end(left), _begin(right)), f" {_COMPARED[type(op)]} "
        case ast.BinOp(left=left, op=op, right=right) if type(op) in _COMPUTED and not isinstance(
            left, ast.Constant | ast.JoinedStr
        ):
            # Between the two there may be brackets: then it is left alone, as the line would not be Python.
            return (_end(left), _begin(right)), f" {_COMPUTED[type(op)]} "
        case ast.Constant(value=float() as value):
            return (_begin(node), _end(node)), repr(2 * value)
        case ast.Constant(value=int() as value) if value > LARGEST_INDEX:
            return (_begin(node), _end(node)), repr(2 * value)
        case ast.Name(id=name) if name in _CALLED:
            return (_begin(node), _end(node)), _CALLED[name]
        case ast.UnaryOp(op=ast.Not(), operand=operand):
            return (_begin(node), _begin(operand)), ""
    return None


def _begin(node: ast.expr) -> _Place:
    return node.lineno, node.col_offset


def _end(node: ast.expr) -> _Place:
    return node.end_lineno or 0, node.end_col_offset or 0
