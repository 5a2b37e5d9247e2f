"""A notebook of examples/ is run as a kernel runs it: cell by cell, in one namespace, in its own folder."""

from __future__ import annotations

import json
import sys
from pathlib import Path
from types import ModuleType

import pytest

from docs.generate.pages import ROOT
from tests.docs.small_runs import small_runs

pytestmark = pytest.mark.slow


# One of them: they differ in the set that is made, and the code of all three is run as scripts.
@pytest.mark.parametrize("name", ["half_registered"])
def test_a_notebook_runs_from_its_first_cell_to_its_last(
    name: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    notebook = ROOT / "examples" / f"{name}.ipynb"
    monkeypatch.chdir(tmp_path)
    monkeypatch.syspath_prepend(notebook.parent)
    # A kernel has arguments of its own, which are none of the walk's.
    monkeypatch.setattr(sys, "argv", ["ipykernel_launcher.py", "-f", "kernel-1.json"])
    monkeypatch.setitem(sys.modules, "ipykernel", ModuleType("ipykernel"))
    namespace = {"__name__": "__main__"}
    with small_runs():
        for cell in json.loads(notebook.read_text("utf-8"))["cells"]:
            if cell["cell_type"] == "code":
                exec(compile("".join(cell["source"]), notebook.name, "exec"), namespace)
    assert (tmp_path / name / "refined" / "report.json").is_file()
    said = capsys.readouterr().out
    assert "of which the COLMAP model in sparse/0 has 4" in said
    assert [line.split()[0] for line in said.splitlines()[-2:]] == ["given", "refined"]
