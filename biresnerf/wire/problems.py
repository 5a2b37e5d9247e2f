"""An error as the service tells it (RFC 9457), and what went wrong with a job or a dataset."""

from __future__ import annotations

from pydantic import BaseModel, ConfigDict, Field

from biresnerf.wire.base import Record


class FieldProblem(BaseModel):
    """One wrong field."""

    model_config = ConfigDict(frozen=True)

    pointer: str = Field(
        description="JSON pointer into the body (`#/options/steps`), or `query/limit` and the like."
    )
    detail: str


class Problem(BaseModel):
    """An error as RFC 9457 has it, with a stable `code`."""

    model_config = ConfigDict(
        frozen=True,
        json_schema_extra={
            "examples": [
                {
                    "type": "urn:biresnerf:problem:unsafe_path",
                    "title": "A file name is not safe",
                    "status": 422,
                    "detail": "The name has a part `..`.",
                    "instance": "/v1/datasets/ds_01/archive",
                    "code": "unsafe_path",
                    "request_id": "5f1c0d9e6a0b4a3c",
                    "retryable": False,
                    "where": "../evil.png",
                    "hint": "Pack the archive with relative names inside one folder.",
                    "errors": [],
                }
            ]
        },
    )

    type: str
    title: str
    status: int
    detail: str
    instance: str | None = None
    code: str
    request_id: str | None = None
    retryable: bool = False
    where: str | None = Field(
        None, description="The file or entry at fault, and the field in it where there is one."
    )
    hint: str | None = Field(None, description="What to do about it.")
    errors: list[FieldProblem] = Field(default_factory=list)


class JobError(Record):
    """Why a job failed.

    ``code`` is the pipeline's own (InputError, RefinementError) or one of the engine's: ``timeout``,
    ``out_of_memory``, ``too_many_crashes``, ``engine_error``. ``log_tail`` is the end of what the job wrote to stderr.
    """

    code: str
    detail: str
    where: str = ""
    hint: str = ""
    retryable: bool = False
    log_tail: str = ""
