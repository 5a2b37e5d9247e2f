"""Pages and notebooks that are made of the code are as the code has them."""

from __future__ import annotations

import json
import re

import pytest

from biresnerf.options.refine_options import RefineOptions
from docs.generate.commands_page import all_commands
from docs.generate.pages import GENERATED, ROOT
from workers.settings.settings import Settings


@pytest.mark.parametrize("path", GENERATED, ids=lambda path: path.relative_to(ROOT).as_posix())
def test_what_is_generated_has_not_drifted(path):
    assert path.read_text("utf-8") == GENERATED[path](), "run `make docs`"


def test_every_option_setting_and_command_has_its_place_and_a_meaning():
    def keys(page: str) -> set[str]:
        rows = re.findall(r"^\| `([^`]+)` \|(.*)\|$", (ROOT / "docs" / page).read_text(), flags=re.M)
        assert all(row.split(" | ")[-1].strip() for _, row in rows)
        return {key for key, _ in rows}

    assert keys("options.md") >= set(RefineOptions.model_fields)
    assert keys("settings.md") == {f"BIRESNERF_{name.upper()}" for name in Settings.model_fields}
    sections = set(re.findall(r"^## (.+)$", (ROOT / "docs/commands.md").read_text(), flags=re.M))
    assert sections == set(all_commands())
    assert {"refine", "submit", "keys create"} <= sections


def test_a_notebook_holds_the_code_of_its_script_and_no_output():
    for path, write in GENERATED.items():
        if path.suffix == ".ipynb":
            cells = json.loads(write())["cells"]
            code = ["".join(cell["source"]) for cell in cells if cell["cell_type"] == "code"]
            script = path.with_suffix(".py").read_text()
            assert code
            assert all(part in script for part in code)
            assert [cell["outputs"] for cell in cells if cell["cell_type"] == "code"] == [[]] * len(code)
