"""Rules that every command follows."""

from __future__ import annotations

import re
import subprocess
import sys

import click
import pytest
from click.testing import CliRunner

from biresnerf import command_line
from biresnerf.command_line import SECTIONS, Section, cli
from biresnerf.commands import exit_codes
from biresnerf.errors import InputError
from docs.generate.commands_page import ROOT, all_commands

COMMANDS = all_commands()
# They run until they are stopped; or what they print is a script, or a story.
WITHOUT_JSON = {"api", "dispatcher", "mcp", "up", "view", "worker", "completion", "demo"}


def test_the_page_of_commands_and_the_help_have_a_place_for_each() -> None:
    page = (ROOT / "docs/command-line.md").read_text("utf-8")
    named = set(re.findall(r"`([a-z-]+)[` ]", page))
    assert {name.split()[0] for name in COMMANDS} <= named
    said = CliRunner().invoke(cli, ["--help"]).stdout
    sections = re.split(r"\n(?=\S[^\n]*:\n)", said)
    users, operators = (
        next(part for part in sections if part.startswith(title))
        for title in ("Run a service:", "Operate a service")
    )
    assert "  up " in users
    assert "  tenants " in operators
    assert sections.index(users) < sections.index(operators)
    assert "Others:" not in said


def test_a_command_is_named_as_the_table_names_it() -> None:
    named = [name for section in SECTIONS for name in section.commands]
    assert len(named) == len(set(named))
    assert {name.split()[0] for name in COMMANDS} == set(named)
    assert [COMMANDS[name].name for name in named if name in COMMANDS] == [n for n in named if n in COMMANDS]


@pytest.mark.parametrize(("extra", "install"), [("client", "biresnerf[client]"), ("", "biresnerf")])
def test_a_command_that_lacks_a_package_says_what_installs_it(
    monkeypatch: pytest.MonkeyPatch, extra: str, install: str
) -> None:
    section = Section("Elsewhere", extra, {"away": "package_that_is_nowhere.commands:away_command"})
    monkeypatch.setattr(command_line, "SECTIONS", (section,))
    assert "(not installed: package_that_is_nowhere)" in CliRunner().invoke(cli, ["--help"]).stdout
    failed = CliRunner().invoke(cli, ["away", "--any", "argument"]).exception
    assert isinstance(failed, InputError)
    assert (failed.code, failed.where) == ("extra_missing", "biresnerf away")
    assert f"pip install '{install}'" in str(failed)


def test_a_mistyped_command_is_answered_with_the_nearest() -> None:
    said = CliRunner().invoke(cli, ["inspct"])
    assert said.exit_code == 2
    assert "Did you mean 'inspect'?" in said.stderr


@pytest.mark.parametrize("name", COMMANDS)
def test_a_command_answers_in_json_and_says_what_each_option_is_for(name: str) -> None:
    options = [part for part in COMMANDS[name].params if isinstance(part, click.Option)]
    assert any("--json" in option.opts for option in options) is (name not in WITHOUT_JSON)
    assert (COMMANDS[name].help or "").strip()
    for option in options:
        assert not option.hidden, option.name
        assert (option.help or "").strip(), f"{option.name} is not explained"


@pytest.mark.parametrize(
    "command",
    ["inspect nowhere", "refine nowhere -o out", "evaluate nowhere truth", "convert nowhere out --to kitti",
     "export nowhere kitti", "view nowhere", "report nowhere", "compare nowhere -o out", "compare-results nowhere out"],
)  # fmt: skip
def test_a_wrong_path_is_answered_before_torch_is_loaded(tmp_path, command: str) -> None:
    code = (
        f"import sys; sys.argv[1:] = {command.split()!r}\n"
        "from biresnerf.command_line import main\n"
        "try: main()\n"
        "except SystemExit as end: print(end.code, {'torch', 'numba', 'pycolmap'} & set(sys.modules))"
    )
    done = subprocess.run(
        [sys.executable, "-c", code], cwd=tmp_path, capture_output=True, text=True, check=True
    )
    assert "nowhere" in done.stderr
    assert done.stdout == f"{exit_codes.INPUT} set()\n"
