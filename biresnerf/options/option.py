"""Metadata of an option."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any, Literal

from pydantic import AfterValidator, BeforeValidator, Field

from biresnerf.stages import Stage

Level = Literal["main", "usual", "expert", "research"]
Schema = dict[str, Any]


@dataclass(frozen=True)
class Option:
    """Metadata of an option, declared beside its type; all but `smaller` are in the JSON schema.

    Attributes:
        stage: the first stage whose work depends on it.
        title: its name in forms and tables.
        changes_result: whether poses, field or verdict depend on it. Other options may change when a run resumes.
        level: main: what forms show first; usual: for every user; expert: for users who know the method; research: for
            experiments with the method; forms show the learning rates alone, last.
        smaller: maps the value of an attempt that ran out of memory to that of the next; None if it saves none.
    """

    stage: Stage
    title: str
    changes_result: bool = True
    level: Level = "expert"
    smaller: Callable[[Any], Any] | None = None

    def __get_pydantic_json_schema__(self, schema: Any, handler: Callable[[Any], Schema]) -> Schema:
        metadata = {"stage": self.stage, "changes_result": self.changes_result, "level": self.level}
        return {**handler(schema), **metadata, "title": self.title}


def all_required(schema: Schema) -> None:
    """Resolved options have no defaults."""
    schema["required"] = list(schema["properties"])
    for field in schema["properties"].values():
        field.pop("default", None)


def divided(by: int, least: int) -> Callable[[int], int]:
    """``value // by``, but not below `least`."""
    return lambda value: min(value, max(least, value // by))


def lowered(by: int, least: int) -> Callable[[int], int]:
    """``value - by``, but not below `least`."""
    return lambda value: min(value, max(least, value - by))


def _listed(names: Any) -> Any:
    """A list as a tuple, which JSON lacks."""
    if not isinstance(names, list | tuple):
        raise ValueError("must be a list")
    return tuple(names)


def _named_once(names: Sequence[str]) -> Sequence[str]:
    twice = [name for name, count in Counter(names).items() if count > 1]
    if twice:
        raise ValueError(f"{twice[0][:100]!r} is named twice")
    return names


# Of lists in which each name may occur once.
ONCE = (BeforeValidator(_listed), AfterValidator(_named_once), Field(json_schema_extra={"uniqueItems": True}))
