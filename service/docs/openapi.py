"""Writes the OpenAPI document: `python -m service.docs.openapi FILE`; docs/openapi.json is such a file."""

from __future__ import annotations

import json
import sys
from pathlib import Path

from service.app import create_app
from workers.settings.settings import Settings


def document() -> str:
    """The document as it is checked in; needs neither database nor network."""
    app = create_app(Settings(database_url="postgresql://nowhere"))
    return json.dumps(app.openapi(), indent=1, ensure_ascii=False) + "\n"


if __name__ == "__main__":
    # The file is written only once the document is complete: an error must not leave it empty.
    Path(sys.argv[1]).write_text(document())
