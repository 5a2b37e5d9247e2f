"""Results that the service sends to addresses of the caller's."""

from __future__ import annotations

from datetime import datetime
from typing import Annotated, Literal, Self

from pydantic import ConfigDict, Field, model_validator

from biresnerf.wire.base import NO_CONTROLS, Record
from biresnerf.wire.problems import JobError

FILES_MOST = 100
_Address = Annotated[str, Field(max_length=8000)]
_Name = Annotated[str, Field(max_length=1000, pattern=NO_CONTROLS)]


class DeliverTo(Record):
    """Addresses that take a job's files by PUT, once it is over. They may be signed, and are not shown again."""

    model_config = ConfigDict(
        json_schema_extra={
            "examples": [{"archive": "https://bucket.s3.amazonaws.com/a.zip?X-Amz-Signature=…"}]
        }
    )

    archive: _Address | None = Field(None, repr=False, description="For one zip of all files.")
    files: dict[_Name, _Address] = Field(
        {}, repr=False, max_length=FILES_MOST, description="For single files, by their names."
    )

    @model_validator(mode="after")
    def _one_at_least(self) -> Self:
        if self.archive is None and not self.files:
            raise ValueError("there is no address")
        return self

    @property
    def addresses(self) -> list[tuple[str | None, str]]:
        """All of them, each with the name of the file; none for the zip."""
        first: list[tuple[str | None, str]] = [] if self.archive is None else [(None, self.archive)]
        return [*first, *self.files.items()]


class DeliveredFile(Record):
    """What became of a file that was to be sent."""

    name: str | None = Field(examples=["transforms.json"], description="Null: one zip of all files.")
    host: str = Field(examples=["bucket.s3.amazonaws.com"])
    state: Literal["waiting", "delivered", "failed"] = "waiting"
    at: datetime | None = Field(None, description="When it was delivered or failed.")
    error: JobError | None = Field(None, examples=[None], description="Why it failed.")
