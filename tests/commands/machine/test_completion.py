"""Shell completion, as the shells request it."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import pytest

from biresnerf.commands import exit_codes
from biresnerf.commands.machine.completion import SHELLS

COMMAND = (sys.executable, "-m", "biresnerf.command_line")
PAGE = Path(__file__).parents[3] / "docs" / "command-line.md"


@pytest.mark.parametrize("shell", SHELLS)
def test_the_script_registers_the_command(shell: str) -> None:
    done = subprocess.run([*COMMAND, "completion", shell], capture_output=True, text=True, check=True)
    assert "_BIRESNERF_COMPLETE" in done.stdout
    if shell == "bash":
        subprocess.run(["bash", "-n"], input=done.stdout, text=True, check=True)


@pytest.mark.parametrize(
    ("words", "offered"), [("biresnerf stat", "status"), ("biresnerf status --js", "--json")]
)
def test_bash_is_offered_commands_and_options(words: str, offered: str) -> None:
    asked = {"_BIRESNERF_COMPLETE": "bash_complete", "COMP_WORDS": words}
    environment = {**os.environ, **asked, "COMP_CWORD": str(len(words.split()) - 1)}
    done = subprocess.run(COMMAND, env=environment, capture_output=True, text=True, check=False)
    assert f"plain,{offered}" in done.stdout.splitlines(), done.stderr


def test_every_exit_status_is_in_the_table_and_no_other() -> None:
    rows = [line for line in PAGE.read_text().splitlines() if line.startswith("| ") and line[2].isdigit()]
    told = {int(number) for row in rows for number in row.split("|")[1].replace(",", " ").split()}
    assert told == {
        value for name, value in vars(exit_codes).items() if name.isupper() and isinstance(value, int)
    }
