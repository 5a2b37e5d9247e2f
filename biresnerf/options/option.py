"""What an option says of itself, where it is declared."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, Literal

from biresnerf.stages import Stage

Level = Literal["usual", "expert", "research"]
Schema = dict[str, Any]


@dataclass(frozen=True)
class Option:
    """What an option says of itself; stands beside its type. The JSON schema has all but `less_memory`.

    Attributes:
        stage: the first stage whose work depends on it.
        changes_result: whether poses, field or verdict depend on it. Those that do not may change on resuming.
        level: whom it is for: everybody, those who know the method, or experiments with it. Forms show the usual ones
            first and those for research not at all.
        less_memory: its value for a second try after the first ran out of memory; None where it saves none.
    """

    stage: Stage
    changes_result: bool = True
    level: Level = "expert"
    less_memory: Callable[[Any], Any] | None = None

    def __get_pydantic_json_schema__(self, schema: Any, handler: Callable[[Any], Schema]) -> Schema:
        told = {"stage": self.stage, "changes_result": self.changes_result, "level": self.level}
        return {**handler(schema), **told}
