"""Every stable code of an error that the library, the job engine or the service can give, found in the source."""

from __future__ import annotations

import ast
import re
from collections.abc import Iterator

from service.http.problems import CATALOGUE
from tests.docs.documented import ROOT

# Those whose first argument, or `code`, is the code.
_RAISED = {
    *(
        "InputError",
        "RefinementError",
        "EngineError",
        "SetupError",
        "Conflict",
        "LimitReached",
        "Unavailable",
    ),
    *("ProblemError", "JobError", "ServiceError"),
}
# Where an error makes itself.
_CLASSMETHODS = {"biresnerf/client/errors.py": {"cls": 0}}
_CODE = re.compile(r"[a-z]+(_[a-z0-9]+)*")


def codes_in_use() -> dict[str, str]:
    """Each code, and a file where it stands."""
    trees = {
        path.relative_to(ROOT).as_posix(): ast.parse(path.read_text("utf-8"))
        for package in ("biresnerf", "workers", "service")
        for path in sorted((ROOT / package).rglob("*.py"))
    }
    places = dict.fromkeys(_RAISED, 0)
    for tree in trees.values():
        places |= _functions_that_take_a_code(tree)
    found = dict.fromkeys(CATALOGUE, "service/http/problems.py")
    for place, tree in trees.items():
        found |= {
            code: place for code in _codes(tree, places | _CLASSMETHODS.get(place, {})) if code not in found
        }
    return found


def _functions_that_take_a_code(tree: ast.Module) -> dict[str, int]:
    """By name, and which of its arguments it is; one that is only given by name stands behind the others."""
    found = {}
    for node in ast.walk(tree):
        if isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef) and not node.name.startswith("__"):
            names = [argument.arg for argument in (*node.args.args, *node.args.kwonlyargs)]
            if "code" in names:
                found[node.name] = names.index("code")
    return found


def _codes(tree: ast.Module, places: dict[str, int]) -> Iterator[str]:
    for node in ast.walk(tree):
        if not isinstance(node, ast.Call):
            continue
        name = getattr(node.func, "id", None) or getattr(node.func, "attr", None)
        if name not in places:
            continue
        at = places[name]
        named = (keyword.value for keyword in node.keywords if keyword.arg == "code")
        for argument in (*node.args[at : at + 1], *named):
            for part in ast.walk(argument):  # `"a" if held else "b"` has two
                word = part.value if isinstance(part, ast.Constant) and isinstance(part.value, str) else ""
                # A function of the same name may take something else, of one word.
                if _CODE.fullmatch(word) and ("_" in word or name in _RAISED):
                    yield word
