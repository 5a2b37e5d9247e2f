"""What goes wrong where files come from or go to addresses of users, in words that hold no secret."""

from __future__ import annotations

from collections.abc import Mapping

from biresnerf.wire.problems import JobError
from workers.webhooks.outbound import trouble_of
from workers.webhooks.webhook_sender import outcome_of, retry_after

# Until an answer's body begins, redirects included, and between two chunks of a body.
HEAD_S, IDLE_S = 60.0, 60.0
# Who is slower, after a while, only occupies a place.
SLOWEST_BYTES_PER_S, SLOW_S = 200e3, 60.0
_REFUSED = {"address_refused", "url_refused"}
_WHY = {
    "address_refused": "leads to an address that the service may not connect to",
    "url_refused": "redirects to an address that the service may not connect to",
    "too_many_redirects": "redirects too often",
    "name_not_found": "is the name of no host",
    "timeout": "does not answer, or is too slow",
    "tls_failed": "has no certificate that the service trusts",
    "connection_failed": "cannot be connected to, or broke the connection",
    "not_http": "ended in the middle, or does not speak HTTP",
}


class TransferFailed(Exception):
    """A try came to nothing; ``again``: the next may do better, after ``wait_s`` at least.

    Where no ``code`` is given, ``detail`` says what the host does.
    """

    def __init__(self, detail: str, *, code: str = "", again: bool = False, wait_s: float = 0.0) -> None:
        self.detail, self.code, self.again, self.wait_s = detail, code, again, wait_s
        super().__init__(detail)

    @classmethod
    def of_trouble(cls, trouble: BaseException) -> TransferFailed:
        """Of one of the `TROUBLES` of a request."""
        code, again = trouble_of(trouble)
        return cls(_WHY[code], code="address_refused" if code in _REFUSED else "", again=again)

    @classmethod
    def of_answer(cls, status: int, headers: Mapping[str, str]) -> TransferFailed:
        """Of an answer that is none of those hoped for."""
        expired = "; a signed address may have expired" if status in {400, 401, 403} else ""
        again = outcome_of(status) == "again"
        wait_s = retry_after(headers.get("retry-after"))
        return cls(f"answers {status}{expired}", again=again, wait_s=wait_s)

    def error(self, host: str | None, where: str, code: str) -> JobError:
        """What the user sees; ``code`` where the failure has none of its own."""
        of_host = self.code in {"", "address_refused"}
        return JobError(
            code=self.code or code,
            detail=f"{host} {self.detail}." if of_host else self.detail,
            where=where,
            hint="Check the address, or sign a new one." if of_host else "",
            retryable=self.again,
        )
