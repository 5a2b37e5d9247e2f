"""The base of all messages between clients and the service."""

from __future__ import annotations

import re
from typing import Annotated, Any, Generic, Self, TypeVar

from pydantic import AwareDatetime, BeforeValidator, ConfigDict, Field, StringConstraints

from biresnerf.frozen_model import FrozenModel


class Record(FrozenModel):
    """Base of every message."""

    # Responses contain every field, those with a default too, so their schemas call all fields required.
    model_config = ConfigDict(json_schema_serialization_defaults_required=True)


T = TypeVar("T")


class Page(Record, Generic[T]):
    """One page of a list."""

    items: tuple[T, ...]
    next_cursor: str | None = Field(None, description="Opaque; null on the last page.")


class Links(Record):
    """Paths of something and of its parts."""

    self: str

    @classmethod
    def below(cls, path: str, **others: str) -> Self:
        """The links of what is at ``path``: each part below it under its own name, but for the ``others``."""
        parts = cls.model_fields.keys() - {"self", *others}
        return cls(self=path, **others, **{part: f"{path}/{part}" for part in parts})


NO_CONTROLS = r"^[^\x00-\x1f]*$"  # the database stores no NUL in text
LABELS_MOST, LABEL_LENGTH = 20, 100
Label = Annotated[str, StringConstraints(min_length=1, max_length=LABEL_LENGTH, pattern=NO_CONTROLS)]
Labels = Annotated[dict[Label, Label], Field(max_length=LABELS_MOST)]


def _no_number(value: Any) -> Any:
    """Refuses what pydantic would read as seconds since 1970."""
    if isinstance(value, int | float) or (
        isinstance(value, str) and not re.match(r"\d{4}-\d\d-\d\d[T ]", value)
    ):
        raise ValueError("a time is written as in 2026-01-31T12:00:00Z")
    return value


Time = Annotated[AwareDatetime, BeforeValidator(_no_number)]
