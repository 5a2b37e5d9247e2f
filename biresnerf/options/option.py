"""What an option says of itself, where it is declared."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

from biresnerf.stages import Stage

Schema = dict[str, Any]


@dataclass(frozen=True)
class Option:
    """What an option says of itself; stands beside its type. The JSON schema has all but `less_memory`.

    Attributes:
        stage: the first stage whose work depends on it.
        changes_result: whether poses, field or verdict depend on it. Those that do not may change on resuming.
        research: for experiments with the method; left out of the page's form.
        less_memory: its value for a second try after the first ran out of memory; None where it saves none.
    """

    stage: Stage
    changes_result: bool = True
    research: bool = False
    less_memory: Callable[[Any], Any] | None = None

    def __get_pydantic_json_schema__(self, schema: Any, handler: Callable[[Any], Schema]) -> Schema:
        told = {"stage": self.stage, "changes_result": self.changes_result, "research": self.research}
        return {**handler(schema), **told}
