"""The errors of responses (RFC 9457), and those of jobs, uploads and datasets."""

from __future__ import annotations

from pydantic import BaseModel, ConfigDict, Field

from biresnerf.errors import Fault


class FieldProblem(BaseModel):
    """One wrong field."""

    model_config = ConfigDict(frozen=True)

    pointer: str = Field(
        description="JSON pointer into the body (`#/options/steps`), or a place such as `query/limit`."
    )
    detail: str


class Problem(Fault):
    """An error response after RFC 9457, with a stable `code`."""

    type: str = Field(examples=["urn:biresnerf:problem:unsafe_path"])
    title: str = Field(examples=["A file name is not safe"])
    status: int = Field(examples=[422])
    instance: str | None = Field(None, examples=["/v1/datasets/ds_01/archive"])
    request_id: str | None = Field(None, examples=["5f1c0d9e6a0b4a3c"])
    retryable: bool = False
    errors: list[FieldProblem] = Field(default_factory=list)


class JobError(Fault):
    """Why a job, an upload or the check of a dataset failed.

    ``code`` is one of the library's (InputError, RefinementError) or of the engine's: ``timeout``,
    ``out_of_memory``, ``too_many_crashes``, ``deadline_passed``, ``engine_error``.
    """

    retryable: bool = False
    log_tail: str = Field("", description="The end of what the job's process wrote to standard error.")
