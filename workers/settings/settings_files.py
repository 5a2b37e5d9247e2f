"""Settings from files: ``BIRESNERF_X_FILE`` names a file that holds the value of ``BIRESNERF_X``.

Containers receive secrets this way: tools that list containers show the environment, and every child process
inherits it; files avoid both.
"""

from __future__ import annotations

import os
from collections.abc import Mapping
from pathlib import Path

from pydantic_settings import BaseSettings, EnvSettingsSource

from workers.settings.errors import SetupError

SUFFIX = "_file"


class FileSettingsSource(EnvSettingsSource):
    """Reads each setting for which a variable with the suffix ``_FILE`` names a file."""

    def __init__(self, settings_class: type[BaseSettings]) -> None:
        """Reads the files; raises `SetupError` for an unreadable file, or a setting that is also given directly."""
        super().__init__(settings_class)
        given, self.env_vars = self.env_vars, {}
        for name in settings_class.model_fields:
            variable = f"{self.env_prefix}{name}".lower()
            path = given.get(variable + SUFFIX)
            if not path or name + SUFFIX in settings_class.model_fields:
                continue
            if given.get(variable) is not None:
                raise SetupError(
                    "setting_given_twice",
                    f"{variable.upper()} and {(variable + SUFFIX).upper()} are both set. Set one of them.",
                )
            self.env_vars = {**self.env_vars, variable: _content(variable + SUFFIX, Path(path))}


def environment_with(variables: Mapping[str, str]) -> dict[str, str]:
    """The environment for a child process: ours and ``variables``, without their ``_FILE`` forms."""
    files = {f"{name}{SUFFIX.upper()}" for name in variables}
    return {**{name: value for name, value in os.environ.items() if name not in files}, **variables}


def _content(variable: str, path: Path) -> str:
    """The file's text without trailing line breaks."""
    try:
        text = path.read_text().rstrip("\r\n")
    except (OSError, UnicodeDecodeError) as error:
        raise SetupError(
            "setting_file_unreadable", f"{variable.upper()} names {path}, which cannot be read: {error}."
        ) from None
    if not text:
        raise SetupError("setting_file_empty", f"{variable.upper()} names {path}, which is empty.")
    return text
