"""The errors of the job engine, one class for each way to handle them."""

from __future__ import annotations

from biresnerf.errors import FaultError


class EngineError(FaultError):
    """Base of the engine's errors."""


class NotFound(EngineError):
    """No such job, dataset or file."""

    def __init__(self, detail: str) -> None:
        super().__init__("not_found", detail)


class Expired(EngineError):
    """The retention time has passed and the files were deleted."""

    def __init__(self, detail: str) -> None:
        super().__init__("expired", detail)


class Conflict(EngineError):
    """The job, dataset or upload exists, but its state does not allow this.

    Codes: ``state_conflict``, ``dataset_not_open``, ``dataset_not_ready``, ``dataset_not_complete``,
    ``dataset_in_use``, ``idempotency_key_reused``, ``offset_mismatch``, ``priority_not_allowed``.
    """


class LimitReached(EngineError):
    """A configured limit is reached.

    Codes: ``body_too_large``, ``too_many_files``, ``queue_full``, ``quota_exhausted``, ``daily_limit_reached``,
    ``storage_full``.
    """


class Unavailable(EngineError):
    """The database or the storage does not answer; a later try may succeed.

    Codes: ``database_unavailable``, ``storage_unavailable``.
    """


class SetupError(EngineError):
    """The operator has to change something before the engine can start; the detail says what and how."""
