"""What FastAPI cannot know of the interface: problems in their own media type, links, and examples."""

from __future__ import annotations

from collections.abc import Sequence
from http import HTTPStatus
from typing import Any

from fastapi import APIRouter, FastAPI
from fastapi.routing import APIRoute
from pydantic import BaseModel

from service.docs.examples import example_of
from service.http.access import REFUSALS
from service.http.problems import MEDIA_TYPE, declared

_PROBLEM = {"$ref": "#/components/schemas/Problem"}


def _by_path(operation: str, parameter: str, answer: str = "$response.body#/id") -> dict[str, Any]:
    return {operation: {"operationId": operation, "parameters": {parameter: answer}}}


# Which values of a response the next calls take: operation -> (status, links).
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
# Problems of every operation, and of those with a JSON body; `REFUSALS` are those of guarded operations.
_ANY = ("malformed_request", "head_timeout", "headers_too_large", "internal_error")
_JSON_BODY = ("malformed_json", "body_too_large", "unsupported_media", "body_timeout", "invalid_request")
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
                status, links = _LINKS.get(operation["operationId"], ("", {}))
                if links:
                    operation["responses"][status]["links"] = links
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
    guarded = bool(operation.get("security"))
    takes_json = "application/json" in operation.get("requestBody", {}).get("content", {})
    return declared(*_ANY, *(REFUSALS if guarded else ()), *(_JSON_BODY if takes_json else ()))


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
                "description": f"{HTTPStatus(int(status)).phrase}: `{'`, `'.join(examples)}`",
                "content": {MEDIA_TYPE: {"schema": _PROBLEM, "examples": examples}},
            }
    return complete
