"""The errors that a client raises."""

from __future__ import annotations

from collections.abc import Mapping

from pydantic import ValidationError

from biresnerf.errors import BiresnerfError, FaultError
from biresnerf.wire.jobs import JobView
from biresnerf.wire.problems import FieldProblem, Problem
from biresnerf.wire.retry_after import retry_after_s

# Statuses that ask to try again later.
_LATER = frozenset({408, 429, 502, 503, 504, 507})
# Those of them that mean that the service did nothing.
_REFUSED = frozenset({408, 429, 503, 507})


class ServiceError(FaultError):
    """The service refused, failed, or could not be reached.

    Attributes:
        code: the problem's stable code; the client's own are ``bad_url``, ``unreachable``,
            ``unexpected_answer``, ``file_changed`` and ``download_damaged``.
        detail: what is wrong, in one sentence.
        status: the HTTP status; 0 where there was no answer.
        where, hint: the file or field at fault, and what to do about it; empty where the service does not say.
        errors: every wrong field by its pointer.
        request_id: the request's id in the service's log; none where there was no answer.
        retry_after_s: how long the service asks to wait.
    """

    def __init__(
        self,
        code: str,
        detail: str,
        *,
        status: int = 0,
        where: str = "",
        hint: str = "",
        errors: tuple[FieldProblem, ...] = (),
        request_id: str | None = None,
        retry_after_s: float | None = None,
        untouched: bool = False,
    ) -> None:
        super().__init__(code, detail, where=where, hint=hint)
        self.status, self.errors, self.request_id = status, errors, request_id
        self.retry_after_s, self._untouched = retry_after_s, untouched

    @property
    def retryable(self) -> bool:
        """Whether the same request may succeed in a moment."""
        return self.code == "idempotency_in_progress" or self.code == "unreachable" or self.status in _LATER

    @property
    def undone(self) -> bool:
        """Whether the service certainly did nothing."""
        return self._untouched or self.status in _REFUSED

    @property
    def users_fault(self) -> bool:
        """Whether the request itself has to change."""
        return 400 <= self.status < 500 and not self.retryable

    @classmethod
    def of_answer(cls, status: int, headers: Mapping[str, str], content: bytes) -> ServiceError:
        """The error in an answer of status 300 or more."""
        wait_s = retry_after_s(headers.get("retry-after"))
        try:
            problem = Problem.model_validate_json(content, extra="ignore")
        except ValidationError:
            return cls.of_foreign_answer(status, request_id=headers.get("x-request-id"), retry_after_s=wait_s)
        return cls.of(
            problem,
            status=status,
            errors=tuple(problem.errors),
            request_id=problem.request_id,
            retry_after_s=wait_s,
        )

    @classmethod
    def of_foreign_answer(
        cls, status: int, *, request_id: str | None = None, retry_after_s: float | None = None
    ) -> ServiceError:
        """An answer that did not come from a BiResNeRF service, but from a proxy or another program."""
        return cls(
            "unexpected_answer",
            f"The answer has status {status} and does not come from a BiResNeRF service.",
            status=status,
            hint="Check the address.",
            request_id=request_id,
            retry_after_s=retry_after_s,
        )


class JobFailed(BiresnerfError):
    """The job failed, was cancelled or has expired; ``job`` is its final state."""

    def __init__(self, job: JobView) -> None:
        self.job = job
        error = job.error
        if error is None:
            super().__init__(f"The job {job.id} is {job.state}.")
            return
        how = "failed" if job.state == "failed" else f"is {job.state}"
        super().__init__(f"The job {job.id} {how} ({error.code}): {error}")


class JobNotOver(BiresnerfError, TimeoutError):
    """The job ``job_id`` was not over after ``timeout_s``. It continues."""

    def __init__(self, job_id: str, timeout_s: float) -> None:
        self.job_id, self.timeout_s = job_id, timeout_s
        super().__init__(f"The job {job_id} is not over after {timeout_s:g} s; it continues.")
