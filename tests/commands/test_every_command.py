"""What every command owes its users."""

from __future__ import annotations

import click
import pytest

from docs.generate.commands_page import all_commands

COMMANDS = all_commands()
# They run until they are stopped; or what they print is a script, or a story.
WITHOUT_JSON = {"api", "dispatcher", "up", "worker", "completion", "demo"}


@pytest.mark.parametrize("name", COMMANDS)
def test_a_command_answers_in_json_and_says_what_each_option_is_for(name: str) -> None:
    options = [part for part in COMMANDS[name].params if isinstance(part, click.Option)]
    assert any("--json" in option.opts for option in options) is (name not in WITHOUT_JSON)
    assert (COMMANDS[name].help or "").strip()
    for option in options:
        assert not option.hidden, option.name
        assert (option.help or "").strip(), f"{option.name} is not explained"
