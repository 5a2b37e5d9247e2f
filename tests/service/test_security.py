"""SECURITY.md says where each rule is held: the places exist, and some rules are held here."""

from __future__ import annotations

import ast
import re
from pathlib import Path

ROOT = Path(__file__).parents[2]
PAGE = (ROOT / "SECURITY.md").read_text()


def test_every_file_and_test_that_the_page_names_exists() -> None:
    named = re.findall(r"`((?:service|workers|biresnerf|tests|docs)/[\w/.]+)(?:::(\w+))?`", PAGE)
    assert len(named) > 60
    for path, test in named:
        assert (ROOT / path).exists(), path
        assert not test or re.search(rf"^(?:async )?def {test}\(", (ROOT / path).read_text(), re.M), test
    for link in re.findall(r"\]\(([^)#]+)", PAGE):
        assert (ROOT / link).exists(), link


def test_nothing_unpickles() -> None:
    unpicklers = {"pickle", "cPickle", "dill", "cloudpickle", "joblib", "shelve", "marshal"}
    for path in [
        file for room in ("biresnerf", "workers", "service") for file in (ROOT / room).rglob("*.py")
    ]:
        text = path.read_text()
        assert "torch.load" not in text, path
        for node in ast.walk(ast.parse(text)):
            names = [alias.name for alias in node.names] if isinstance(node, ast.Import) else []
            names += [node.module or ""] if isinstance(node, ast.ImportFrom) else []
            assert not unpicklers & {name.split(".")[0] for name in names}, path
            if isinstance(node, ast.Call) and ast.unparse(node.func) in {"np.load", "numpy.load"}:
                allowed = {key.arg: ast.unparse(key.value) for key in node.keywords}.get("allow_pickle")
                assert allowed == "False", f"{path}:{node.lineno}"
