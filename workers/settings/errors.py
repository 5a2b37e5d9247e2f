"""Errors of the job engine that callers tell apart. Each carries a stable ``code``."""

from __future__ import annotations

from biresnerf.errors import BiresnerfError


class EngineError(BiresnerfError):
    """Base: ``code`` is snake_case and stable, ``what`` one sentence for people."""

    def __init__(self, code: str, what: str) -> None:
        self.code, self.what = code, what
        super().__init__(what)


class NotFound(EngineError):
    """No such job, dataset or file."""

    def __init__(self, what: str) -> None:
        super().__init__("not_found", what)


class Expired(EngineError):
    """It was kept for its time, and its files are gone."""

    def __init__(self, what: str) -> None:
        super().__init__("expired", what)


class Conflict(EngineError):
    """The thing exists, but its state does not allow this.

    Codes: ``state_conflict``, ``dataset_not_open``, ``dataset_not_ready``, ``dataset_not_complete``,
    ``dataset_in_use``, ``idempotency_key_reused``, ``offset_mismatch``, ``priority_not_allowed``.
    """


class LimitReached(EngineError):
    """A configured limit is reached. Codes: ``body_too_large``, ``too_many_files``, ``queue_full``,
    ``quota_exhausted``, ``storage_full``.
    """


class Unavailable(EngineError):
    """The database or the storage does not answer just now; trying again later may work.

    Codes: ``database_unavailable``, ``storage_unavailable``.
    """


class SetupError(EngineError):
    """The operator has to change something before the engine can start; ``what`` says what and how."""
