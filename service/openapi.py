"""The OpenAPI document: `python -m service.openapi FILE` writes it; docs/openapi.json holds it."""

from __future__ import annotations

import json
import sys
from pathlib import Path
from typing import Any

from fastapi import FastAPI

from service.examples import EXAMPLES
from service.problems import MEDIA_TYPE

_PROBLEM = {"$ref": "#/components/schemas/Problem"}
# Where the next call takes its values from, as far as the path alone does not tell: operation -> (status, links).
_LINKS: dict[str, tuple[str, dict[str, Any]]] = {
    "finalizeDataset": (
        "200",
        {"submitJob": {"operationId": "submitJob", "requestBody": {"dataset_id": "$response.body#/id"}}},
    ),
    "uploadArchive": (
        "200",
        {
            "finalizeDataset": {
                "operationId": "finalizeDataset",
                "parameters": {"dataset_id": "$response.body#/id"},
            }
        },
    ),
}
# FastAPI's own form of a 422, which this service never answers with.
_UNUSED = ("HTTPValidationError", "ValidationError")


def describe(app: FastAPI) -> None:
    """Makes ``app.openapi()`` tell problems in their own media type, and an example of everything."""
    generate = app.openapi

    def openapi() -> dict[str, Any]:
        if app.openapi_schema:
            return app.openapi_schema
        document = generate()
        for path in document["paths"].values():
            for operation in path.values():
                operation["responses"] = _answers(operation["responses"])
                status, links = _LINKS.get(operation["operationId"], ("", {}))
                if links:
                    operation["responses"][status]["links"] = links
        schemas = document["components"]["schemas"]
        for name in _UNUSED:
            schemas.pop(name, None)
        for name, example in EXAMPLES.items():
            schemas[name]["examples"] = [example]
        app.openapi_schema = document
        return document

    app.openapi = openapi  # type: ignore[method-assign]


def _answers(responses: dict[str, Any]) -> dict[str, Any]:
    """The answers in order of status, problems as problems."""
    told = {}
    for status, response in sorted(responses.items()):
        if int(status) >= 400:
            examples = response.get("content", {}).get(MEDIA_TYPE, {}).get("examples")
            if examples is None:
                continue  # FastAPI declares its own 422 wherever there are parameters
            response["content"] = {MEDIA_TYPE: {"schema": _PROBLEM, "examples": examples}}
        told[status] = response
    return told


def document() -> str:
    """The document as it is checked in; needs neither database nor network."""
    from service.app import create_app
    from workers.settings import Settings

    app = create_app(Settings(database_url="postgresql://nowhere"))
    return json.dumps(app.openapi(), indent=1, ensure_ascii=False) + "\n"


if __name__ == "__main__":
    # Into a file only once it is whole: a fault must not leave an empty document behind.
    Path(sys.argv[1]).write_text(document())
