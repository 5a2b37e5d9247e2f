"""All generated files, each with its writer."""

from __future__ import annotations

import json
from collections.abc import Callable
from functools import partial
from pathlib import Path

from docs.generate.commands_page import commands_page
from docs.generate.format_tables import format_page, page_formats
from docs.generate.notebooks import notebook
from docs.generate.options_page import option_titles, options_page
from docs.generate.pictures.badges import badges
from docs.generate.pictures.conventions import conventions_svg
from docs.generate.result_schema import result_schema
from docs.generate.settings_page import settings_page
from service.app import create_app
from workers.settings.settings import Settings

ROOT = Path(__file__).resolve().parents[2]


def openapi_document() -> str:
    """The HTTP interface; needs neither database nor network."""
    app = create_app(Settings(database_url="postgresql://nowhere"))
    return json.dumps(app.openapi(), indent=1, ensure_ascii=False) + "\n"


def _writers() -> dict[Path, Callable[[], str]]:
    formats = ROOT / "docs/formats.md"
    walks = [path for path in sorted((ROOT / "examples").glob("*.py")) if "# %%" in path.read_text("utf-8")]
    return {
        ROOT / "docs/options.md": options_page,
        ROOT / "docs/settings.md": settings_page,
        ROOT / "docs/commands.md": commands_page,
        formats: partial(format_page, formats),
        ROOT / "service/web/formats.json": page_formats,
        ROOT / "biresnerf/viewer/option_titles.json": option_titles,
        ROOT / "docs/result.schema.json": result_schema,
        ROOT / "docs/openapi.json": openapi_document,
        ROOT / "docs/pictures/conventions.svg": conventions_svg,
        **badges(ROOT),
        **{walk.with_suffix(".ipynb"): partial(notebook, walk) for walk in walks},
    }


# The writer of each page's and notebook's current text.
GENERATED = _writers()
