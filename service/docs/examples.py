"""Builds an example of any model from the examples of its fields; raises if the model refuses it."""

from __future__ import annotations

from datetime import datetime
from types import NoneType
from typing import Annotated, Any, Literal, get_args, get_origin

from pydantic import BaseModel
from pydantic.fields import FieldInfo

from biresnerf.options.refine_options import RefineOptions, ResolvedOptions


def example_of(model: type[BaseModel]) -> dict[str, Any]:
    """An example of ``model`` as JSON: defaults and examples of its fields, and of nested models.

    Raises:
        LookupError: a required field has no example, and its type alone suggests none.
    """
    values: dict[str, Any] = {}
    for name, field in model.model_fields.items():
        try:
            if _is_shown(field):
                values[name] = field.examples[0] if field.examples else _of_type(field.annotation)
        except LookupError as error:
            raise LookupError(f"{model.__name__}.{name}: {error}") from None
    return model.model_validate(values).model_dump(mode="json")


def _is_shown(field: FieldInfo) -> bool:
    """Whether to show an example in place of the field's default; a nested model always gets one."""
    composed = field.default_factory is None and _has_model(field.annotation)
    return bool(field.examples) or field.is_required() or composed


def _has_model(kind: Any) -> bool:
    return _is_model(kind) or any(map(_has_model, get_args(kind)))


def _is_model(kind: Any) -> bool:
    return isinstance(kind, type) and issubclass(kind, BaseModel)


def _of_type(kind: Any) -> Any:
    origin = get_origin(kind)
    parts = [part for part in get_args(kind) if part is not NoneType]
    if kind is ResolvedOptions:
        return RefineOptions(preset="fast").resolved("cpu").model_dump(mode="json")
    if _is_model(kind):
        return example_of(kind)
    if kind is datetime:
        return "2026-11-21T19:00:00Z"
    if kind is bool:
        return False
    if origin in (list, tuple):
        return [_of_type(parts[0])]
    if origin is dict:
        return {_of_type(parts[0]): _of_type(parts[1])}
    if origin is Literal:
        return parts[0]
    if origin is Annotated or len(parts) == 1:
        return _of_type(parts[0])
    raise LookupError(f"{kind} needs an example")
