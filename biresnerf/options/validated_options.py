"""Options from untrusted values: every wrong key is named, and the option that was probably meant."""

from __future__ import annotations

from collections.abc import Mapping
from difflib import get_close_matches
from typing import Any, TypeVar

from pydantic import BaseModel, ValidationError
from pydantic_core import InitErrorDetails, PydanticCustomError

from biresnerf.errors import InputError

Parsed = TypeVar("Parsed", bound=BaseModel)


def with_near_names(error: ValidationError, model: type[BaseModel]) -> ValidationError:
    """The same error, which suggests the nearest field of `model` for each unknown key."""
    details = []
    for item in error.errors():
        detail = InitErrorDetails(
            type=item["type"], loc=item["loc"], input=item["input"], ctx=item.get("ctx", {})
        )
        if item["type"] == "extra_forbidden":
            detail = InitErrorDetails(
                type=_error(str(item["loc"][-1]), list(model.model_fields)),
                loc=item["loc"],
                input=item["input"],
            )
        details.append(detail)
    return ValidationError.from_exception_data(error.title, details)


def _error(name: str, known: list[str]) -> PydanticCustomError:
    near = get_close_matches(name, known, n=1)
    if not near:
        return PydanticCustomError("unknown_option", "unknown option")
    return PydanticCustomError("unknown_option", "unknown option (did you mean `{near}`?)", {"near": near[0]})


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
