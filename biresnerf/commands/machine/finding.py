"""What a check of an installation found."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Literal, TypeAlias

# good; missing: only something optional cannot be done; broken: it should work and does not.
State = Literal["good", "missing", "broken"]


@dataclass(frozen=True)
class Found:
    """What a check found, and what to do about it where it is not good."""

    name: str
    state: State
    detail: str
    hint: str = ""


Check: TypeAlias = Callable[[], Found]
