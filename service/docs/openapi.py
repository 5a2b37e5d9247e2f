"""The OpenAPI document: `python -m service.docs.openapi FILE` writes it; docs/openapi.json holds it."""

from __future__ import annotations

import json
import sys
from http import HTTPStatus
from pathlib import Path
from typing import Any

from fastapi import FastAPI

from service.docs.examples import EXAMPLES
from service.http.access import REFUSALS
from service.http.problems import MEDIA_TYPE, declared

_PROBLEM = {"$ref": "#/components/schemas/Problem"}


# Where the next call takes its values from, as far as the path alone does not tell: operation -> (status, links).
def _by_path(operation: str, parameter: str, answer: str = "$response.body#/id") -> dict[str, Any]:
    return {operation: {"operationId": operation, "parameters": {parameter: answer}}}


_LINKS: dict[str, tuple[str, dict[str, Any]]] = {
    "createDataset": (
        "201",
        {
            **_by_path("putFile", "dataset_id"),
            **_by_path("uploadArchive", "dataset_id"),
            **_by_path("createUpload", "dataset_id"),
            **_by_path("finalizeDataset", "dataset_id"),
        },
    ),
    "createUpload": ("201", {**_by_path("appendUpload", "upload_id"), **_by_path("getUpload", "upload_id")}),
    "uploadArchive": ("200", _by_path("finalizeDataset", "dataset_id")),
    "finalizeDataset": (
        "200",
        {"submitJob": {"operationId": "submitJob", "requestBody": {"dataset_id": "$response.body#/id"}}},
    ),
    "submitJob": ("202", {**_by_path("getJob", "job_id"), **_by_path("cancelJob", "job_id")}),
}
# What a request may be answered with before it reaches its operation.
_ANY = ("malformed_request", "head_timeout", "headers_too_large", "internal_error")
_ANYWHERE, _GUARDED = declared(*_ANY), declared(*_ANY, *REFUSALS)
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
            for method, operation in path.items():
                early = _GUARDED if operation.get("security") else _ANYWHERE
                operation["responses"] = _answers(operation["responses"], early)
                if method == "head":
                    operation["responses"]["200"].pop("content", None)
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


def _answers(responses: dict[str, Any], early: dict[int | str, dict[str, Any]]) -> dict[str, Any]:
    """The answers in order of status, problems as problems, with those that come before the operation."""
    told: dict[str, Any] = {}
    for status, response in sorted({**{str(key): {} for key in early}, **responses}.items()):
        if int(status) < 400:
            told[status] = response
            continue
        # Without examples it is FastAPI's own 422, which it declares wherever there are parameters.
        examples = dict(response.get("content", {}).get(MEDIA_TYPE, {}).get("examples", {}))
        if int(status) in early:
            examples |= early[int(status)]["content"][MEDIA_TYPE]["examples"]
        if examples:
            told[status] = {
                "description": f"{HTTPStatus(int(status)).phrase}: `{'`, `'.join(examples)}`",
                "content": {MEDIA_TYPE: {"schema": _PROBLEM, "examples": examples}},
            }
    return told


def document() -> str:
    """The document as it is checked in; needs neither database nor network."""
    from service.app import create_app
    from workers.settings.settings import Settings

    app = create_app(Settings(database_url="postgresql://nowhere"))
    return json.dumps(app.openapi(), indent=1, ensure_ascii=False) + "\n"


if __name__ == "__main__":
    # Into a file only once it is whole: a fault must not leave an empty document behind.
    Path(sys.argv[1]).write_text(document())
