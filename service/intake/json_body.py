"""JSON bodies, read strictly: of limited size, no NaN, no repeated keys, a pointer to every wrong field."""

from __future__ import annotations

import json
import re
from collections.abc import AsyncIterator, Callable, Coroutine, Iterable
from contextlib import asynccontextmanager
from typing import Any, TypeVar

from fastapi import Request, Response
from fastapi.routing import APIRoute
from pydantic import BaseModel, ValidationError
from starlette.types import Scope

from biresnerf.wire.problems import FieldProblem
from service.http.dependencies import JSON_FREE_BYTES, service_of
from service.http.problems import ProblemError
from service.intake.uploads import limited_body

JSON_BYTES_MAX = 2**20
Model = TypeVar("Model", bound=BaseModel)


class JsonRoute(APIRoute):
    """A route with a JSON body, which is read strictly before FastAPI validates it."""

    def get_route_handler(self) -> Callable[[Request], Coroutine[Any, Any, Response]]:
        """The handler of requests; FastAPI calls it once for the route."""
        handle, field = super().get_route_handler(), self.body_field
        if field is None:
            return handle

        async def handle_strictly(request: Request) -> Response:
            if not field.field_info.is_required() and not request.headers.get("content-type"):
                return await handle(request)
            async with read_json(request, self.bytes_max(request)) as values:
                return await handle(_ReadRequest(request.scope, values))

        return handle_strictly

    def bytes_max(self, _: Request) -> int:
        """The largest size of the body."""
        return JSON_BYTES_MAX


class _ReadRequest(Request):
    """A request whose JSON body was read."""

    def __init__(self, scope: Scope, values: Any) -> None:
        super().__init__(scope)
        self._body, self._json = b"read", values


@asynccontextmanager
async def read_json(request: Request, limit: int = JSON_BYTES_MAX) -> AsyncIterator[Any]:
    """The values of a body of at most ``limit`` bytes; it counts against the limits while the context lasts.

    Raises:
        ProblemError: ``unsupported_media``, ``body_too_large``, ``too_many_uploads``, ``malformed_json``.
    """
    content_type = request.headers.get("content-type", "")
    if content_type.split(";")[0].strip().lower() != "application/json":
        raise ProblemError(
            "unsupported_media",
            f"The Content-Type {content_type!r} is not application/json.",
            where="Content-Type",
        )
    body = bytearray()
    with service_of(request).bodies.counted(request.state.client) as hold:
        async for chunk in limited_body(request, limit):
            hold(max(0, len(body) + len(chunk) - JSON_FREE_BYTES))
            body += chunk
        values = load_json(bytes(body))
        body.clear()
        yield values


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
        raise validation_problem({**item, "loc": ("body", *item["loc"])} for item in error.errors()) from None


def _no_constant(name: str) -> float:
    raise ValueError(f"{name} is no JSON number")


def _no_repeats(pairs: list[tuple[str, Any]]) -> dict[str, Any]:
    values = dict(pairs)
    if len(values) < len(pairs):
        raise ValueError("A key occurs twice")
    return values


def validation_problem(found: Iterable[Any]) -> ProblemError:
    """Pydantic's findings as one problem; ``invalid_options`` where an option is at fault."""
    fields = [FieldProblem(pointer=_pointer(item["loc"]), detail=_detail(item)) for item in found]
    in_options = any(re.match(r"#(/jobs/\d+)?/options", field.pointer) for field in fields)
    return ProblemError(
        "invalid_options" if in_options else "invalid_request",
        "; ".join(f"{field.pointer}: {field.detail}" for field in fields[:10]),
        hint="GET /v1/options lists the options and their ranges." if in_options else "",
        errors=fields[:100],
    )


def _pointer(location: tuple[int | str, ...]) -> str:
    """`/query/limit`, and `#/options/steps` for what FastAPI calls body, options, steps."""
    # RFC 6901 escapes; a key of the user's may hold anything.
    parts = [str(part).replace("~", "~0").replace("/", "~1")[:100] for part in location]
    return "/".join(["#", *parts[1:]] if parts[0] == "body" else ["", *parts])


def _detail(item: Any) -> str:
    if item["type"] == "extra_forbidden":
        return "There is no such field."
    return f"{item['msg']}."


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
