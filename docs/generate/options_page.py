"""docs/options.md, from `RefineOptions` and the presets."""

from __future__ import annotations

import json

from biresnerf.options.option import Level
from biresnerf.options.presets import (
    COMMON_VALUES,
    CUDA_SCALE,
    METHOD_PAPER_VALUES,
    METHOD_VALUES,
    PRESETS,
)
from biresnerf.options.refine_options import OPTIONS, RefineOptions
from docs.generate.markdown import DASH, code, table
from docs.generate.schema_words import takes

_LEVELS: dict[Level, str] = {
    "main": "The main options",
    "usual": "Further options",
    "expert": "Schedule, sizes and output",
    "research": "For research",
}
_HEAD = """# Options of a refinement

Written by `make docs`. Set any of them with `--set KEY=VALUE` on the command line (`--preset`, `--device` and `--seed` have flags
of their own), in the object `options` of a job over HTTP, or by name in Python (`biresnerf.refine(..., steps=2000)`). On the command
line a value is JSON where possible, else text: `--set holdout=0`, `--set start=given`. `GET /v1/options` has the JSON Schema.

- Start with the [quick start](quick-start.md); [method](method.md) explains what they do, with the paper's symbols.
- An option that is left out has the method's value, else the preset's, else its default.
- If you set `steps` alone, `coarse_steps_min`, `coarse_steps_max`, `check_every` and `warmup_steps` are scaled with it.
  `trial_steps` becomes a quarter of `steps` where the preset has more.
- *touches* is the first stage that an option affects; [a fork](jobs.md#forks) that changes it takes over the stages before. Options
  that do not affect the poses may also change when a run resumes.
- The worker resolves options for its device. A job shows them as `options` (as requested) and `resolved_options` (as used).
- The page's form leaves out the options for research.
"""


def option_titles() -> str:
    """The options' titles on the page and in report.html: biresnerf/viewer/option_titles.json."""
    titles = {name: option.title for name, option in OPTIONS.items()}
    return json.dumps(titles, indent=1, ensure_ascii=False) + "\n"


def options_page() -> str:
    """The page."""
    schema = RefineOptions.model_json_schema()
    definitions = schema.get("$defs", {})
    rows: dict[Level, list[tuple[str, ...]]] = {level: [] for level in _LEVELS}
    by_preset = []
    for key, field in schema["properties"].items():
        meaning = field["description"].rstrip(".")
        option = OPTIONS[key]
        touches = option.stage if option.changes_result else f"{option.stage}; not the poses"
        rows[option.level].append((f"`{key}`", _default(key), takes(field, definitions), meaning, touches))
        if any(key in values for values in PRESETS.values()):
            by_preset.append((f"`{key}`", *(code(PRESETS[name][key]) for name in PRESETS)))
    scaled = " and ".join(f"{factor} times `{key}`" for key, factor in CUDA_SCALE.items())
    return "\n".join(
        (
            _HEAD,
            *(
                f"## {title}\n\n{table(('key', 'default', 'takes', 'meaning', 'touches'), rows[level])}"
                for level, title in _LEVELS.items()
            ),
            "## What the presets fill in\n",
            table(("key", *(f"`{name}`" for name in PRESETS)), by_preset),
            f"With `device` `cuda` every preset but `paper` takes {scaled}.\n",
            "## What methods fill in instead\n",
            _methods(),
        )
    )


def _default(key: str) -> str:
    if any(key in values for values in PRESETS.values()):
        return "preset"
    if key in COMMON_VALUES:
        return code(COMMON_VALUES[key])
    default = RefineOptions.model_fields[key].default
    return DASH if default is None or default == () else code(default)


def _methods() -> str:
    rows = []
    for name, values in METHOD_VALUES.items():
        for title, filled in (
            (f"`{name}`", values),
            (f"`{name}` in the preset `paper`", METHOD_PAPER_VALUES.get(name)),
        ):
            if filled:
                rows.append((title, ", ".join(f"`{key}={_plain(value)}`" for key, value in filled.items())))
    return table(("method", "fills in"), rows)


def _plain(value: object) -> str:
    return code(value).strip("`")
