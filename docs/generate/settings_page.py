"""docs/settings.md, from the deployment settings."""

from __future__ import annotations

from typing import Any

from docs.generate.markdown import DASH, code, table
from docs.generate.schema_words import takes
from workers.settings.settings import GIB, MIB, Settings

_HEAD = """# Settings of an installation

Written by `make docs` from `workers/settings/settings.py`; a test fails when they differ.

Environment variables of the service's processes; the same for every process of one installation. Lists are JSON:
`BIRESNERF_WEBHOOK_NETWORKS='["10.0.0.0/8"]'`. Each can be given by a file instead: `BIRESNERF_X_FILE` names a file that
holds the value of `BIRESNERF_X`. `up` and `api` have flags for some. What the limits are for: [access.md](access.md),
[operations.md](operations.md), [storage.md](storage.md), [webhooks.md](webhooks.md).
"""
# What differs from machine to machine.
_IN_WORDS = {
    "data_dir": "`/var/lib/biresnerf` for root, else `~/.local/share/biresnerf`",
    "job_command": "`python -m workers.run.job_process`",
    "check_command": "`python -m workers.datasets.dataset_check_process`",
}


def settings_page() -> str:
    """The page."""
    schema = Settings.model_json_schema()
    definitions = schema.get("$defs", {})
    rows = [
        (
            f"`BIRESNERF_{key.upper()}`",
            _default(key),
            takes(field, definitions),
            field["description"].rstrip("."),
        )
        for key, field in schema["properties"].items()
    ]
    return _HEAD + "\n" + table(("variable", "default", "takes", "meaning"), rows)


def _default(key: str) -> str:
    if key in _IN_WORDS:
        return _IN_WORDS[key]
    value: Any = Settings.model_fields[key].default
    if value is None or value == ():
        return DASH
    if key.endswith("_bytes") and value % MIB == 0:
        return f"`{value}` ({value // GIB} GiB)" if value % GIB == 0 else f"`{value}` ({value // MIB} MiB)"
    return code(value)
