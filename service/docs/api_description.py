"""Completes FastAPI's OpenAPI document: the media type of problems, links, and examples."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

from fastapi import APIRouter, FastAPI
from fastapi.routing import APIRoute
from pydantic import BaseModel

from service.docs.examples import example_of
from service.http.access import REFUSALS
from service.http.problems import MEDIA_TYPE, declared, phrase

_PROBLEM = {"$ref": "#/components/schemas/Problem"}


_ID = "$response.body#/id"
# The next calls with the id in a response: operation -> (status, parameter, operations).
_NEXT = {
    "createDataset": ("201", "dataset_id", ["putFile", "uploadArchive", "createUpload", "finalizeDataset"]),
    "createUpload": ("201", "upload_id", ["appendUpload", "getUpload"]),
    "uploadArchive": ("200", "dataset_id", ["finalizeDataset"]),
    "finalizeDataset": ("200", "dataset_id", ["submitJob"]),
    "submitJob": ("202", "job_id", ["getJob", "cancelJob"]),
    "submitBatch": ("202", "batch_id", ["getBatch", "cancelBatch"]),
}
# Problems of every operation, and of those with a JSON body; `REFUSALS` are those of guarded operations.
_ANY = ("malformed_request", "head_timeout", "headers_too_large", "internal_error")
_JSON_BODY = (
    *("malformed_json", "body_too_large", "unsupported_media", "body_timeout", "invalid_request"),
    "too_many_uploads",
)
# FastAPI's own 422, which this service never sends.
_UNUSED = ("HTTPValidationError", "ValidationError")


def describe(app: FastAPI, routers: Sequence[APIRouter]) -> None:
    """Completes the document of ``app.openapi()``; ``routers`` are all that it includes."""
    generate = app.openapi

    def openapi() -> dict[str, Any]:
        if app.openapi_schema:
            return app.openapi_schema
        document = generate()
        for path in document["paths"].values():
            for method, operation in path.items():
                operation["responses"] = _answers(operation["responses"], _common_problems(operation))
                if method == "head":
                    operation["responses"]["200"].pop("content", None)
                if operation["operationId"] in _NEXT:
                    status, parameter, following = _NEXT[operation["operationId"]]
                    operation["responses"][status]["links"] = {
                        name: _link(name, parameter) for name in following
                    }
        schemas = document["components"]["schemas"]
        for name in _UNUSED:
            schemas.pop(name, None)
        for model in _models(routers):
            schemas[model.__name__]["examples"] = [example_of(model)]
        app.openapi_schema = document
        return document

    app.openapi = openapi  # type: ignore[method-assign]


def _common_problems(operation: dict[str, Any]) -> dict[int | str, dict[str, Any]]:
    """The problems of all operations of this kind, which routes need not declare."""
    codes = list(_ANY)
    if operation.get("security"):
        codes += REFUSALS
    if "application/json" in operation.get("requestBody", {}).get("content", {}):
        codes += _JSON_BODY
    parameters = {parameter["name"]: parameter["in"] for parameter in operation.get("parameters", [])}
    if "path" in parameters.values():
        codes.append("not_found")
    if "query" in parameters.values():
        codes.append("invalid_request")
    if "cursor" in parameters:
        codes.append("bad_cursor")
    return declared(*codes)


def _link(operation: str, parameter: str) -> dict[str, Any]:
    """The OpenAPI link by which ``operation`` takes the id of a response."""
    if operation == "submitJob":
        return {"operationId": operation, "requestBody": {parameter: _ID}}
    return {"operationId": operation, "parameters": {parameter: _ID}}


def _models(routers: Sequence[APIRouter]) -> set[type[BaseModel]]:
    """The models of all responses."""
    routes = [route for router in routers for route in router.routes if isinstance(route, APIRoute)]
    declared = [response.get("model") for route in routes for response in route.responses.values()]
    return {model for model in (*(route.response_model for route in routes), *declared) if model is not None}


def _answers(responses: dict[str, Any], common: dict[int | str, dict[str, Any]]) -> dict[str, Any]:
    """The responses by status, with the ``common`` problems; problems have their own media type."""
    complete: dict[str, Any] = {}
    for status, response in sorted({**{str(key): {} for key in common}, **responses}.items()):
        if int(status) < 400:
            complete[status] = response
            continue
        # Without examples it is FastAPI's own 422, which it declares wherever there are parameters.
        examples = dict(response.get("content", {}).get(MEDIA_TYPE, {}).get("examples", {}))
        if int(status) in common:
            examples |= common[int(status)]["content"][MEDIA_TYPE]["examples"]
        if examples:
            complete[status] = {
                "description": f"{phrase(int(status))}: `{'`, `'.join(examples)}`",
                "content": {MEDIA_TYPE: {"schema": _PROBLEM, "examples": examples}},
            }
    return complete
