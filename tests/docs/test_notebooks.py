"""A notebook of examples/ is run as a kernel runs it: cell by cell, in one namespace, in its own folder."""

from __future__ import annotations

import json
import sys
from pathlib import Path
from typing import Any

import pytest

from docs.generate.notebooks import notebook
from docs.generate.pages import ROOT
from tests.docs.small_runs import small_runs

pytestmark = pytest.mark.slow


# One of them: they differ in the set that is made, and the code of all three is run as scripts.
@pytest.mark.parametrize("name", ["half_registered"])
def test_a_notebook_runs_from_its_first_cell_to_its_last(
    name: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    path = ROOT / "examples" / f"{name}.ipynb"
    monkeypatch.chdir(tmp_path)
    monkeypatch.syspath_prepend(path.parent)
    monkeypatch.setattr(sys, "argv", [f"{name}.py"])
    namespace = {"__name__": "__main__"}
    with small_runs():
        for cell in json.loads(path.read_text("utf-8"))["cells"]:
            if cell["cell_type"] == "code":
                exec(compile("".join(cell["source"]), path.name, "exec"), namespace)
    assert (tmp_path / name / "refined" / "report.json").is_file()
    said = capsys.readouterr().out
    assert "of which the COLMAP model in sparse/0 has 4" in said
    assert [line.split()[0] for line in said.splitlines()[-2:]] == ["given", "refined"]


def test_a_walk_takes_the_arguments_of_a_script_and_none_of_a_kernel(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    pytest.importorskip("nbclient")
    pytest.importorskip("ipykernel")  # which loads IPython, as other tests of this process may
    from docs.generate.run_notebooks import executed

    monkeypatch.syspath_prepend(ROOT / "examples")
    monkeypatch.setattr(sys, "argv", ["phone_capture.py", "--output", "elsewhere"])
    from walk import arguments

    assert arguments("phone_capture", views=1, size=1).output == Path("elsewhere")
    walk = f"import sys\nsys.path.insert(0, {str(ROOT / 'examples')!r})\nfrom walk import arguments\n"
    code = "print(len(sys.argv) > 1, arguments('phone_capture', views=1, size=1).output)"
    (cell,) = code_cells(executed(notebook(written(tmp_path, walk + code))))
    assert cell["outputs"][0]["text"] == ["True phone_capture\n"], "a kernel has arguments of its own"


def code_cells(text: str) -> list[dict[str, Any]]:
    return [cell for cell in json.loads(text)["cells"] if cell["cell_type"] == "code"]


def written(folder: Path, code: str) -> Path:
    script = folder / "small.py"
    script.write_text(f'"""Small."""\n\n# %% [markdown]\n# # Small\n\n# %%\n{code}\n')
    return script


def test_a_kernel_runs_a_notebook_and_what_it_shows_stays_as_long_as_its_code(tmp_path: Path) -> None:
    pytest.importorskip("nbclient")
    from docs.generate.run_notebooks import executed

    script = written(tmp_path, "import sys\nprint(2 + 3)\nprint('the bar', file=sys.stderr)\n7 * 6")
    done = executed(notebook(script))
    (cell,) = code_cells(done)
    assert [output["output_type"] for output in cell["outputs"]] == ["stream", "execute_result"]
    assert cell["outputs"][0]["text"] == ["5\n"]
    assert cell["outputs"][1]["data"]["text/plain"] == ["42"]
    script.with_suffix(".ipynb").write_text(done)
    assert notebook(script) == done
    assert code_cells(notebook(written(tmp_path, "7 * 7")))[0]["outputs"] == []
    with pytest.raises(Exception, match="ZeroDivisionError"):
        executed(notebook(written(tmp_path, "1 / 0")))
