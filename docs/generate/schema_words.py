"""The values that a model's field takes, in words, from its JSON Schema."""

from __future__ import annotations

from typing import Any

_KINDS = {"integer": "whole number", "number": "number", "boolean": "`true` or `false`", "string": "text"}


def takes(schema: dict[str, Any], definitions: dict[str, Any]) -> str:
    """For example ``whole number, 20 to 1000000`` or ``a``, ``b``: without null, which stands for the default."""
    if "$ref" in schema:
        return takes(definitions[schema["$ref"].rsplit("/", 1)[1]], definitions)
    choices = [part for part in schema.get("anyOf", ()) if part.get("type") != "null"]
    if choices:
        return " or ".join(dict.fromkeys(takes(part, definitions) for part in choices))
    if "enum" in schema:
        return ", ".join(f"`{value}`" for value in schema["enum"])
    if "const" in schema:
        return f"`{schema['const']}`"
    if schema.get("type") == "array":
        return f"list of: {takes(schema['items'], definitions)}"
    if schema.get("format") == "path":
        return "path"
    kind = _KINDS[schema["type"]]
    return ", ".join(part for part in (kind, _range(schema)) if part)


def _range(schema: dict[str, Any]) -> str:
    low, high = schema.get("minimum"), schema.get("maximum")
    above, below = schema.get("exclusiveMinimum"), schema.get("exclusiveMaximum")
    if low is not None and high is not None:
        return f"{low:g} to {high:g}" if max(low, high) < 1e6 else f"{low} to {high}"
    parts = [
        f"at least {low}" if low is not None else "",
        f"above {above}" if above is not None else "",
        f"at most {high}" if high is not None else "",
        f"below {below}" if below is not None else "",
    ]
    return ", ".join(part for part in parts if part)
