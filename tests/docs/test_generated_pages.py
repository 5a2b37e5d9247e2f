"""Pages and notebooks that are generated from the code are up to date."""

from __future__ import annotations

import json
import re
from importlib.metadata import version

import click
import pytest

from biresnerf.options.refine_options import RefineOptions
from docs.generate.commands_page import all_commands
from docs.generate.pages import GENERATED, ROOT
from workers.settings.settings import Settings


@pytest.mark.parametrize("path", GENERATED, ids=lambda path: path.relative_to(ROOT).as_posix())
def test_what_is_generated_has_not_drifted(path):
    if (
        path.suffix == ".json"
        and f"\npydantic=={version('pydantic')}\n" not in (ROOT / "constraints.txt").read_text()
    ):
        pytest.skip("another pydantic than the pinned one writes another schema")
    assert path.read_text("utf-8") == GENERATED[path](), "run `make docs`"


def test_every_option_setting_and_command_has_its_place_and_a_meaning():
    def keys(page: str) -> set[str]:
        rows = re.findall(r"^\| `([^`]+)` \|(.*)\|$", (ROOT / "docs" / page).read_text(), flags=re.M)
        assert all(row.split(" | ")[-1].strip() for _, row in rows)
        return {key for key, _ in rows}

    assert keys("options.md") >= set(RefineOptions.model_fields)
    assert keys("settings.md") == {f"BIRESNERF_{name.upper()}" for name in Settings.model_fields}
    named = set(sections_of_commands())
    assert named - {"Options of several commands"} == set(all_commands())
    assert {"refine", "submit", "keys create"} <= named


def sections_of_commands() -> dict[str, str]:
    parts = re.split(r"^## (.+)$", (ROOT / "docs/commands.md").read_text(), flags=re.M)[1:]
    return dict(zip(parts[::2], parts[1::2], strict=True))


def described_in(section: str) -> set[str]:
    """Options that have a row there."""
    return set(re.findall(r"^\| `(?:-\w, )?(--[\w-]+)", section, flags=re.M))


def test_a_command_names_all_its_options_and_each_is_described_there_or_with_those_of_several():
    sections = sections_of_commands()
    shared = described_in(sections["Options of several commands"])
    assert {"--json", "--url", "--api-key"} <= shared
    for name, command in all_commands().items():
        named = set(re.findall(r"`(?:-\w, )?(--[\w-]+)", sections[name]))
        options = {
            next(text for text in parameter.opts if text.startswith("--"))
            for parameter in command.params
            if isinstance(parameter, click.Option) and not parameter.hidden and "--help" not in parameter.opts
        }
        elsewhere = {
            option
            for other, listed in re.findall(
                r"^\[As of `([\w -]+)`\]\(#[\w-]+\): (.+)\.$", sections[name], flags=re.M
            )
            for option in set(re.findall(r"--[\w-]+", listed)) & described_in(sections[other])
        }
        assert options <= named, name
        assert options <= described_in(sections[name]) | elsewhere | shared, name


def test_a_notebook_holds_the_code_of_its_script():
    for path, write in GENERATED.items():
        if path.suffix == ".ipynb":
            cells = json.loads(write())["cells"]
            code = ["".join(cell["source"]) for cell in cells if cell["cell_type"] == "code"]
            script = path.with_suffix(".py").read_text()
            assert code
            assert all(part in script for part in code)
