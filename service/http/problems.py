"""Every error the service answers with: one model, one catalogue of codes, one place that renders them."""

from __future__ import annotations

import logging
from http import HTTPStatus
from typing import Any

from biresnerf.errors import FaultError
from biresnerf.wire.problems import FieldProblem, Problem
from workers.settings.errors import EngineError

logger = logging.getLogger(__name__)

MEDIA_TYPE = "application/problem+json"
RETRY_AFTER_S = "5"
# What ends only with a job, or when its owner makes room.
_LONGER_S = {"queue_full": "30", "quota_exhausted": "60"}

# code -> (status, title). A code stands for one kind of mistake and never changes its meaning.
CATALOGUE: dict[str, tuple[int, str]] = {
    "malformed_request": (400, "The request is not well-formed HTTP"),
    "malformed_json": (400, "The body is not valid JSON"),
    "malformed_body": (400, "The body could not be read"),
    "bad_range": (400, "The Range header is malformed"),
    "bad_idempotency_key": (400, "The Idempotency-Key header is malformed"),
    "bad_cursor": (400, "The cursor is not one this service gave out"),
    "metrics_token_required": (401, "The figures are not open to everybody"),
    "missing_credentials": (401, "An API key is needed"),
    "invalid_api_key": (401, "The API key is not valid"),
    "scope_required": (403, "The API key may not do that"),
    "priority_not_allowed": (403, "The tenant may not ask for so high a priority"),
    "cross_site": (403, "Another web site sent this request"),
    "not_found": (404, "There is no such thing here"),
    "method_not_allowed": (405, "This address does not answer that method"),
    "head_timeout": (408, "The request did not come"),
    "body_timeout": (408, "The body did not go on"),
    "dataset_not_ready": (409, "The dataset is not ready for jobs"),
    "dataset_in_use": (409, "A job uses the dataset"),
    "dataset_not_open": (409, "The dataset takes no more files"),
    "dataset_not_complete": (409, "Files of the dataset are missing"),
    "state_conflict": (409, "The state does not allow that"),
    "idempotency_in_progress": (409, "The first request with this key is still running"),
    "offset_mismatch": (409, "The upload goes on elsewhere"),
    "too_many_webhooks": (409, "There are as many webhooks as the service takes"),
    "fork_not_possible": (409, "No work of the job can be taken over"),
    "result_not_ready": (409, "The job has no result yet"),
    "direct_upload_unavailable": (409, "Files cannot be sent to the store itself"),
    "upload_incomplete": (409, "Not all of it has arrived at the store"),
    "link_expired": (410, "The link is not good any more"),
    "expired": (410, "It was kept for its time and is gone"),
    "file_exists": (412, "The file is there already"),
    "precondition_failed": (412, "A condition of the request does not hold"),
    "body_too_large": (413, "The body is larger than the service takes"),
    "too_many_files": (413, "There are more files than the service takes"),
    "archive_too_large": (413, "The archive unpacks to more than the service takes"),
    "image_too_large": (413, "An image is larger than the service takes"),
    "unsupported_media": (415, "This kind of content is not taken here"),
    "range_not_satisfiable": (416, "The file does not have those bytes"),
    "invalid_request": (422, "The request does not fit the schema"),
    "invalid_options": (422, "The options are not valid"),
    "idempotency_key_reused": (422, "The key was used for a different request"),
    "unsafe_path": (422, "A file name is not safe"),
    "name_collision": (422, "Two files have one name but for case or accents"),
    "archive_rejected": (422, "The archive cannot be taken"),
    "webhook_url_refused": (422, "Webhooks cannot go to this address"),
    "digest_mismatch": (422, "The bytes do not have the digest that was announced"),
    "dataset_invalid": (422, "The images and poses cannot be used"),
    "validation_timeout": (422, "Checking the files took too long"),
    "validation_resources": (422, "Checking the files took too much memory or crashed"),
    "headers_too_large": (431, "The head of the request is too large"),
    "queue_full": (429, "Too many jobs are waiting"),
    "quota_exhausted": (429, "The tenant has all that it may have"),
    "rate_limited": (429, "Too many requests came in a short time"),
    "too_many_uploads": (429, "Too many uploads came at the same time"),
    "internal_error": (500, "Something is wrong with the service"),
    "unavailable": (503, "The service is not ready"),
    "queue_unavailable": (503, "The queue does not work"),
    "database_unavailable": (503, "The database does not answer"),
    "storage_unavailable": (503, "The file storage does not answer"),
    "storage_full": (507, "There is no room left for files"),
}


class ProblemError(FaultError):
    """Raised anywhere in the service to answer with a problem; the catalogue gives status and title."""

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
        return self.status in {429, 503, 507} or self.code in {
            "idempotency_in_progress",
            "result_not_ready",
        }

    def response_headers(self) -> dict[str, str]:
        """Extra headers of the answer; what may be tried again says when."""
        wait_s = _LONGER_S.get(self.code, RETRY_AFTER_S)
        return {**({"Retry-After": wait_s} if self.retryable else {}), **self.headers}

    def problem(self, instance: str | None = None, request_id: str | None = None) -> Problem:
        """The body of the answer."""
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
    """The answer to an error of the library or of the engine."""
    if isinstance(error, ProblemError):
        return error
    if isinstance(error, EngineError) and error.code not in CATALOGUE:
        logger.error("engine error that is missing from the catalogue: %s", error.code)
        return ProblemError("internal_error", error.detail)
    return ProblemError.of(error.fault)


def declared(*codes: str) -> dict[int | str, dict[str, Any]]:
    """The OpenAPI `responses` of a route that may answer with these codes."""
    by_status: dict[int, list[str]] = {}
    for code in codes:
        by_status.setdefault(CATALOGUE[code][0], []).append(code)
    return {
        status: {
            "model": Problem,
            "description": f"{HTTPStatus(status).phrase}: `{'`, `'.join(names)}`",
            "content": {MEDIA_TYPE: {"examples": {name: _example(name) for name in names}}},
        }
        for status, names in sorted(by_status.items())
    }


def _example(code: str) -> dict[str, Any]:
    """The problem as it looks where there is nothing special to say."""
    title = CATALOGUE[code][1]
    problem = ProblemError(code, f"{title}.").problem("/v1/…", "5f1c0d9e6a0b4a3c")
    return {"summary": title, "value": problem.model_dump(mode="json", exclude_defaults=True)}
