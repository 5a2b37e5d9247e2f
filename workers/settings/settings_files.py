"""Settings from files: ``BIRESNERF_X_FILE`` names a file that holds the value of ``BIRESNERF_X``.

That is how containers are given secrets: an environment is shown by every tool that lists containers and is
handed on to every child, a file is not.
"""

from __future__ import annotations

import os
from collections.abc import Mapping
from pathlib import Path

from pydantic_settings import BaseSettings, EnvSettingsSource

from workers.settings.errors import SetupError

SUFFIX = "_file"


class FileSettingsSource(EnvSettingsSource):
    """Reads every setting whose variable, with ``_FILE`` behind it, names a file."""

    def __init__(self, settings_class: type[BaseSettings]) -> None:
        """Reads the files; raises `SetupError` for one that cannot be read or stands beside the setting itself."""
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
    """This process's environment for a child, with these variables, and without files that name them again."""
    files = {f"{name}{SUFFIX.upper()}" for name in variables}
    return {**{name: value for name, value in os.environ.items() if name not in files}, **variables}


def _content(variable: str, path: Path) -> str:
    """The file's text without the line break that editors and ``echo`` put behind it."""
    try:
        text = path.read_text().rstrip("\r\n")
    except (OSError, UnicodeDecodeError) as error:
        raise SetupError(
            "setting_file_unreadable", f"{variable.upper()} names {path}, which cannot be read: {error}."
        ) from None
    if not text:
        raise SetupError("setting_file_empty", f"{variable.upper()} names {path}, which is empty.")
    return text
