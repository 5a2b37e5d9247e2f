"""`biresnerf completion SHELL`: a script that completes commands and options."""

from __future__ import annotations

import click
from click.shell_completion import get_completion_class

NAME = "biresnerf"
SHELLS = ("bash", "zsh", "fish")


@click.command("completion")
@click.argument("shell", type=click.Choice(SHELLS))
@click.pass_context
def completion_command(context: click.Context, shell: str) -> None:
    """Print a script for SHELL that completes commands and options.

    bash: add `eval "$(biresnerf completion bash)"` to ~/.bashrc; zsh: the same in ~/.zshrc; fish:
    `biresnerf completion fish > ~/.config/fish/completions/biresnerf.fish`.
    """
    kind = get_completion_class(shell)
    assert kind is not None  # click has these three
    click.echo(kind(context.find_root().command, {}, NAME, f"_{NAME.upper()}_COMPLETE").source())
