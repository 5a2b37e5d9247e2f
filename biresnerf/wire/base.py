"""The base of all messages between clients and the service."""

from __future__ import annotations

from typing import Annotated

from pydantic import ConfigDict, Field, StringConstraints

from biresnerf.frozen_model import FrozenModel


class Record(FrozenModel):
    """Base of every message."""

    # Responses contain every field, those with a default too, so their schemas call all fields required.
    model_config = ConfigDict(json_schema_serialization_defaults_required=True)


LABELS_MOST, LABEL_LENGTH = 20, 100
Label = Annotated[str, StringConstraints(min_length=1, max_length=LABEL_LENGTH, pattern=r"^[^\x00-\x1f]*$")]
Labels = Annotated[dict[Label, Label], Field(max_length=LABELS_MOST)]
