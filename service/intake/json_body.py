"""JSON bodies, read strictly: of limited size, no NaN, no repeated keys, a pointer to every wrong field."""

from __future__ import annotations

import json
from collections.abc import Awaitable, Callable, Iterable
from typing import Any, TypeVar

from fastapi import Request
from pydantic import BaseModel, ValidationError

from biresnerf.wire.problems import FieldProblem
from service.http.problems import ProblemError
from service.intake.uploads import capped, refuse_announced_excess

JSON_BYTES_MAX = 2**20
Model = TypeVar("Model", bound=BaseModel)


async def read_json(request: Request, model: type[Model], limit: int = JSON_BYTES_MAX) -> Model:
    """The body, of ``limit`` bytes at most, as the model.

    Raises:
        ProblemError: ``unsupported_media``, ``body_too_large``, ``malformed_json``, ``invalid_request``,
            ``invalid_options``.
    """
    content_type = request.headers.get("content-type", "")
    if content_type.split(";")[0].strip().lower() != "application/json":
        raise ProblemError(
            "unsupported_media",
            f"The Content-Type {content_type!r} is not application/json.",
            where="Content-Type",
        )
    refuse_announced_excess(request.headers.get("content-length"), limit)
    body = b"".join([chunk async for chunk in capped(request.stream(), limit)])
    return validate(load_json(body), model)


def body_of(model: type[Model]) -> Callable[[Request], Awaitable[Model]]:
    """A dependency that reads the request's body as the model."""

    async def read(request: Request) -> Model:
        return await read_json(request, model)

    return read


def load_json(text: bytes | str) -> Any:
    """JSON text as values; raises `ProblemError` ``malformed_json``."""
    try:
        return json.loads(text, parse_constant=_no_constant, object_pairs_hook=_no_repeats)
    except RecursionError:
        raise ProblemError("malformed_json", "The JSON is nested too deeply.") from None
    except ValueError as error:
        raise ProblemError("malformed_json", f"{error}.") from None


def validate(values: Any, model: type[Model]) -> Model:
    """Values as the model; raises `ProblemError` with the pointer of every wrong field."""
    try:
        return model.model_validate(values)
    except ValidationError as error:
        raise validation_problem(error.errors()) from None


def _no_constant(name: str) -> float:
    raise ValueError(f"{name} is no JSON number")


def _no_repeats(pairs: list[tuple[str, Any]]) -> dict[str, Any]:
    values = dict(pairs)
    if len(values) < len(pairs):
        raise ValueError("A key is there twice")
    return values


def validation_problem(found: Iterable[Any], below: str = "#") -> ProblemError:
    """Pydantic's findings as one problem; ``invalid_options`` where an option is at fault."""
    fields = [FieldProblem(pointer=_pointer(item["loc"], below), detail=_detail(item)) for item in found]
    in_options = any(field.pointer.startswith("#/options") for field in fields)
    return ProblemError(
        "invalid_options" if in_options else "invalid_request",
        "; ".join(f"{field.pointer}: {field.detail}" for field in fields[:10]),
        hint="GET /v1/options lists the options and their ranges." if in_options else "",
        errors=fields[:100],
    )


def _pointer(location: tuple[int | str, ...], below: str) -> str:
    # RFC 6901 escapes; a key of the user's may hold anything.
    parts = [str(part).replace("~", "~0").replace("/", "~1")[:100] for part in location]
    return "/".join([below, *parts])


def _detail(item: Any) -> str:
    if item["type"] == "extra_forbidden":
        return "There is no such field."
    return f"{item['msg']}."


def json_request(model: type[BaseModel], *, required: bool = True) -> dict[str, Any]:
    """The `openapi_extra` of a route that reads its JSON body by hand."""
    body: dict[str, Any] = {"content": {"application/json": json_content(model)}}
    return {"requestBody": {"required": True, **body} if required else body}


def json_content(model: type[BaseModel]) -> dict[str, Any]:
    """The OpenAPI media-type object of a body that is read by hand; nested models are written out."""
    schema = model.model_json_schema()
    definitions = schema.pop("$defs", {})
    return {"schema": _written_out(schema, definitions)}


def _written_out(schema: Any, definitions: dict[str, Any]) -> Any:
    if isinstance(schema, list):
        return [_written_out(item, definitions) for item in schema]
    if not isinstance(schema, dict):
        return schema
    rest = {key: _written_out(value, definitions) for key, value in schema.items() if key != "$ref"}
    if "$ref" in schema:
        target = _written_out(definitions[schema["$ref"].rsplit("/", 1)[-1]], definitions)
        return {**target, **rest}
    return rest
