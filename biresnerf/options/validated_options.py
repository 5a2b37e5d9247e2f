"""Options from untrusted values: every wrong key is named, and the option that was probably meant."""

from __future__ import annotations

from collections.abc import Mapping
from difflib import get_close_matches
from typing import Any, TypeVar

from pydantic import BaseModel, ValidationError
from pydantic_core import InitErrorDetails, PydanticCustomError

from biresnerf.errors import InputError

Parsed = TypeVar("Parsed", bound=BaseModel)


def refuse_unknown(values: Any, model: type[BaseModel]) -> None:
    """Raises `ValidationError` if `values` is a mapping with keys that are no fields of `model`."""
    if not isinstance(values, Mapping):
        return
    errors = [
        InitErrorDetails(type=_error(name, list(model.model_fields)), loc=(name,), input=value)
        for name, value in values.items()
        if isinstance(name, str) and name not in model.model_fields
    ]
    if errors:
        raise ValidationError.from_exception_data(model.__name__, errors)


def _error(name: str, known: list[str]) -> PydanticCustomError:
    near = get_close_matches(name, known, n=1)
    if not near:
        return PydanticCustomError("unknown_option", "unknown option")
    return PydanticCustomError("unknown_option", "unknown option; did you mean `{near}`?", {"near": near[0]})


def validated(model: type[Parsed], values: Mapping[str, Any]) -> Parsed:
    """The model of the values.

    Raises:
        InputError: ``invalid_options``, with the path of every wrong key.
    """
    try:
        return model.model_validate(values)
    except ValidationError as error:
        problems = [
            f"{'.'.join(str(part) for part in item['loc']) or 'options'}: {item['msg']}"
            for item in error.errors()
        ]
        raise InputError(
            "invalid_options",
            "; ".join(problems) + ".",
            where="options",
            hint="docs/options.md and GET /v1/options list all options.",
        ) from None
