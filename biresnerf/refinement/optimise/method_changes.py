"""Variants of the named methods: fields changed by name, and differences listed."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import fields, is_dataclass, replace
from typing import Any, get_type_hints

from pydantic import TypeAdapter, ValidationError

from biresnerf.errors import InputError
from biresnerf.refinement.optimise.methods import Method, Recipe, find_method


def changed(method: Method, changes: Mapping[str, Any]) -> Method:
    """The method with other values of some fields, by name: ``repair``, or ``merging.light`` within another field.

    Raises:
        InputError: ``invalid_options``: there is no such field, or the value is of another kind.
    """
    for name, value in changes.items():
        method = _with(method, name.split("."), value, name)
    return method


def _with(holder: Any, path: list[str], value: Any, asked: str) -> Any:
    name, *rest = path
    if not is_dataclass(holder) or isinstance(holder, type) or name not in _names(holder):
        raise InputError("invalid_options", "is no field of the method.", where=f"method.{asked}")
    if rest:
        found = _with(getattr(holder, name), rest, value, asked)
    else:
        try:
            found = TypeAdapter(get_type_hints(type(holder))[name]).validate_python(value)
        except ValidationError as error:
            said = error.errors()[0]["msg"].lower()
            raise InputError("invalid_options", f"{value!r}: {said}.", where=f"method.{asked}") from None
    return replace(holder, **{name: found})


def differences(recipe: Recipe) -> dict[str, str]:
    """What differs from the method that the options name: functions and classes by name, other values as text."""
    own, named = recipe.method, find_method(recipe.options.method)
    each = (_between(getattr(own, name), getattr(named, name, None), name) for name in _names(own))
    return {name: text for found in each for name, text in found.items()}


def _between(own: Any, other: Any, name: str) -> dict[str, str]:
    if type(own) is type(other) and is_dataclass(own) and not callable(own):
        parts = ((getattr(own, each), getattr(other, each), f"{name}.{each}") for each in _names(own))
        return {name: text for part in parts for name, text in _between(*part).items()}
    return {} if own == other else {name: _text(own)}


def _names(holder: Any) -> list[str]:
    return [field.name for field in fields(holder)]


def _text(value: Any) -> str:
    if hasattr(value, "__qualname__"):
        return f"{value.__module__}.{value.__qualname__}"
    return repr(value) if not callable(value) or is_dataclass(value) else type(value).__qualname__


def method_warnings(recipe: Recipe) -> tuple[str, ...]:
    """A warning where a run was not of the method that its options name."""
    found = ", ".join(f"{name}={text}" for name, text in differences(recipe).items())
    return (f"The method was not {recipe.options.method} as it comes: {found}.",) if found else ()
