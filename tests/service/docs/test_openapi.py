"""The checked-in OpenAPI document matches the service."""

from __future__ import annotations

import json
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import jsonschema_rs
import pytest

from docs.generate.pages import openapi_document

CHECKED_IN = Path(__file__).parents[3] / "docs" / "openapi.json"
DOCUMENT: dict[str, Any] = json.loads(CHECKED_IN.read_text())
OPERATIONS = {
    operation["operationId"]: (method, path, operation)
    for path, operations in DOCUMENT["paths"].items()
    for method, operation in operations.items()
}


def test_the_checked_in_document_is_what_the_service_tells() -> None:
    """If this fails after a change of the interface: `make docs`, and read the difference."""
    written = openapi_document()
    assert json.loads(written) == DOCUMENT
    assert written == CHECKED_IN.read_text()


def contents(identity: str) -> Iterator[tuple[str, str, dict[str, Any]]]:
    """Bodies in and out: what it is, its media type, its OpenAPI media-type object."""
    _, _, operation = OPERATIONS[identity]
    for kind, content in operation.get("requestBody", {}).get("content", {}).items():
        yield "request", kind, content
    for status, answer in operation["responses"].items():
        for kind, content in answer.get("content", {}).items():
            yield status, kind, content


def validator(schema: dict[str, Any]) -> Any:
    return jsonschema_rs.Draft202012Validator({**schema, "components": DOCUMENT["components"]})


def resolved(schema: dict[str, Any]) -> dict[str, Any]:
    name = schema.get("$ref", "").rpartition("/")[2]
    return DOCUMENT["components"]["schemas"][name] if name else schema


def examples_of(content: dict[str, Any]) -> list[Any]:
    found = [example["value"] for example in content.get("examples", {}).values()]
    found += [content["example"]] if "example" in content else []
    return found + resolved(content.get("schema", {})).get("examples", [])


@pytest.mark.parametrize("identity", OPERATIONS)
def test_every_json_body_has_an_example_that_fits_its_schema(identity: str) -> None:
    for what, kind, content in contents(identity):
        if "json" not in kind:
            continue
        examples = examples_of(content)
        assert examples, (what, kind)
        for example in examples:
            validator(content["schema"]).validate(example)


@pytest.mark.parametrize("identity", OPERATIONS)
def test_every_operation_says_what_it_does_and_every_error_by_its_codes(identity: str) -> None:
    _, path, operation = OPERATIONS[identity]
    assert operation["description"]
    assert operation["tags"]
    assert "500" in operation["responses"]
    for status, answer in operation["responses"].items():
        if status < "400":
            continue
        (content,) = answer["content"].values()
        codes = set(content["examples"])
        assert codes, (path, status)
        for code, example in content["examples"].items():
            assert (example["value"]["code"], str(example["value"]["status"])) == (code, status)
            assert f"`{code}`" in answer["description"]


def test_every_schema_of_the_document_is_sound() -> None:
    for schema in DOCUMENT["components"]["schemas"].values():
        jsonschema_rs.meta.validate({**schema, "$schema": "https://json-schema.org/draft/2020-12/schema"})
