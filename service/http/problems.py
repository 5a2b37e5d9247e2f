"""The errors of the HTTP interface: the catalogue of codes with their status, and the error that carries one."""

from __future__ import annotations

import logging
import random
import time
from http import HTTPStatus
from typing import Any

from biresnerf.errors import FaultError
from biresnerf.wire.problems import FieldProblem, Problem
from workers.settings.errors import EngineError

logger = logging.getLogger(__name__)

MEDIA_TYPE = "application/problem+json"
# Drawn anew for each answer: clients refused together would come back together.
RETRY_AFTER_S = (2, 12)
# These end only when a job ends or its owner deletes something.
_LONGER_S = {"queue_full": "30", "quota_exhausted": "60"}

# code -> (status, title). A code stands for one kind of error and never changes its meaning.
CATALOGUE: dict[str, tuple[int, str]] = {
    "malformed_request": (400, "The request is not well-formed HTTP"),
    "malformed_json": (400, "The body is not valid JSON"),
    "malformed_body": (400, "The body could not be read"),
    "bad_range": (400, "The Range header is malformed"),
    "bad_idempotency_key": (400, "The Idempotency-Key header is malformed"),
    "bad_cursor": (400, "The cursor is not from this service"),
    "metrics_token_required": (401, "Metrics need a token"),
    "missing_credentials": (401, "An API key is required"),
    "invalid_api_key": (401, "The API key is not valid"),
    "scope_required": (403, "The API key lacks the scope"),
    "priority_not_allowed": (403, "The priority is higher than the tenant's limit"),
    "cross_site": (403, "The request comes from another web page"),
    "not_found": (404, "Not found"),
    "method_not_allowed": (405, "The method is not allowed here"),
    "head_timeout": (408, "The request headers did not arrive in time"),
    "body_timeout": (408, "The request body stopped arriving"),
    "dataset_not_ready": (409, "The dataset is not ready for jobs"),
    "dataset_in_use": (409, "The dataset is used by a job"),
    "dataset_not_open": (409, "The dataset no longer accepts files"),
    "dataset_not_complete": (409, "Files of the dataset are missing"),
    "state_conflict": (409, "The current state does not allow this"),
    "idempotency_in_progress": (409, "The first request with this key is still running"),
    "offset_mismatch": (409, "The upload continues at another offset"),
    "too_many_webhooks": (409, "Too many webhooks"),
    "fork_not_possible": (409, "No stage of the job can be reused"),
    "result_not_ready": (409, "The job has no result yet"),
    "direct_upload_unavailable": (409, "Direct uploads to the store are not available"),
    "upload_incomplete": (409, "The upload at the store is incomplete"),
    "link_expired": (410, "The link has expired"),
    "expired": (410, "The retention time is over; the files were deleted"),
    "file_exists": (412, "The file exists already"),
    "precondition_failed": (412, "A precondition of the request failed"),
    "body_too_large": (413, "The body is too large"),
    "too_many_files": (413, "Too many files"),
    "archive_too_large": (413, "The unpacked archive is too large"),
    "image_too_large": (413, "The image is too large"),
    "unsupported_media": (415, "Unsupported content type"),
    "range_not_satisfiable": (416, "The requested range lies outside the file"),
    "invalid_request": (422, "The request does not match the schema"),
    "invalid_options": (422, "The options are not valid"),
    "idempotency_key_reused": (422, "The key was used for a different request"),
    "unsafe_path": (422, "A file name is not safe"),
    "name_collision": (422, "Two file names differ only in case or accents"),
    "archive_rejected": (422, "The archive is not acceptable"),
    "address_refused": (422, "Files do not come from or go to this address"),
    "fetch_failed": (422, "The file could not be fetched"),
    "webhook_url_refused": (422, "Webhooks to this address are not allowed"),
    "deadline_refused": (422, "The deadline has passed or is too far ahead"),
    "digest_mismatch": (422, "The digest of the bytes is not the announced one"),
    "dataset_invalid": (422, "The images and poses cannot be used"),
    "validation_timeout": (422, "Checking the files took too long"),
    "validation_resources": (422, "Checking the files took too much memory or crashed"),
    "headers_too_large": (431, "The request headers are too large"),
    "queue_full": (429, "Too many jobs are waiting"),
    "quota_exhausted": (429, "The tenant's quota is exhausted"),
    "daily_limit_reached": (429, "The tenant's jobs have run long enough today"),
    "rate_limited": (429, "Too many requests in a short time"),
    "too_many_uploads": (429, "Too many uploads at the same time"),
    "client_gone": (499, "The client went away"),
    "internal_error": (500, "The service failed"),
    "unavailable": (503, "The service is not ready"),
    "queue_unavailable": (503, "The queue is not available"),
    "database_unavailable": (503, "The database does not answer"),
    "storage_unavailable": (503, "The file storage does not answer"),
    "storage_full": (507, "The file storage is full"),
}


class ProblemError(FaultError):
    """Raised anywhere in the service to respond with a problem; the catalogue gives status and title."""

    def __init__(
        self,
        code: str,
        detail: str,
        *,
        where: str = "",
        hint: str = "",
        errors: list[FieldProblem] | None = None,
        headers: dict[str, str] | None = None,
    ) -> None:
        super().__init__(code, detail, where=where, hint=hint)
        # Codes of the library that are not in the catalogue are all mistakes in the content.
        self.status, self.title = CATALOGUE.get(code, (422, "The content cannot be used"))
        self.errors = errors or []
        self.headers = headers or {}

    @property
    def retryable(self) -> bool:
        """Whether the same request may succeed later."""
        return self.status in {429, 503, 507} or self.code in {"idempotency_in_progress", "result_not_ready"}

    def response_headers(self) -> dict[str, str]:
        """Extra headers of the response; a retryable one says when to retry."""
        wait_s = _LONGER_S.get(self.code) or str(random.randint(*RETRY_AFTER_S))
        if self.code == "daily_limit_reached":  # days of UTC begin at multiples of 86400 s
            wait_s = str(86400 - int(time.time()) % 86400)
        return {**({"Retry-After": wait_s} if self.retryable else {}), **self.headers}

    def problem(self, instance: str | None = None, request_id: str | None = None) -> Problem:
        """The body of the response."""
        return Problem(
            **dict(self.fault),
            type=f"urn:biresnerf:problem:{self.code}",
            title=self.title,
            status=self.status,
            instance=instance,
            request_id=request_id,
            retryable=self.retryable,
            errors=self.errors,
        )


def problem_of(error: FaultError) -> ProblemError:
    """The response to an error of the library or of the engine."""
    if isinstance(error, ProblemError):
        return error
    if isinstance(error, EngineError) and error.code not in CATALOGUE:
        logger.error("engine error that is missing from the catalogue: %s", error.code)
        return ProblemError("internal_error", error.detail)
    return ProblemError.of(error.fault)


def wrong_field(pointer: str, detail: str) -> ProblemError:
    """``invalid_request`` for one field, parameter or header."""
    return ProblemError("invalid_request", detail, errors=[FieldProblem(pointer=pointer, detail=detail)])


def declared(*codes: str) -> dict[int | str, dict[str, Any]]:
    """The OpenAPI `responses` of a route that may respond with these codes.

    `service.docs.api_description` adds the codes of every route, of guarded routes, and of JSON bodies.
    """
    by_status: dict[int, list[str]] = {}
    for code in codes:
        by_status.setdefault(CATALOGUE[code][0], []).append(code)
    return {
        status: {
            "model": Problem,
            "description": f"{phrase(status)}: `{'`, `'.join(names)}`",
            "content": {MEDIA_TYPE: {"examples": {name: _example(name) for name in names}}},
        }
        for status, names in sorted(by_status.items())
    }


_PHRASES = {413: "Content Too Large", 416: "Range Not Satisfiable", 422: "Unprocessable Content"}


def phrase(status: int) -> str:
    """A status in RFC 9110's words; Python's own before 3.13 are older."""
    return _PHRASES.get(status) or HTTPStatus(status).phrase


def _example(code: str) -> dict[str, Any]:
    """The problem with its title as the detail."""
    title = CATALOGUE[code][1]
    problem = ProblemError(code, f"{title}.").problem("/v1/…", "5f1c0d9e6a0b4a3c")
    return {"summary": title, "value": problem.model_dump(mode="json", exclude_defaults=True)}
