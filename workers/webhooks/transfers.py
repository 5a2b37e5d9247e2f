"""Transfers of files from and to users' addresses, with error messages that contain no secrets."""

from __future__ import annotations

import logging
from abc import abstractmethod
from typing import Any, ClassVar

from biresnerf.errors import FaultError
from biresnerf.wire.problems import JobError
from workers.database.claimed_work import LeasedWork
from workers.database.database import Database
from workers.database.losses import LOSSES_MAX
from workers.database.notifications import Listener
from workers.settings.errors import Unavailable
from workers.settings.settings import Settings
from workers.webhooks.outbound import TROUBLES, Answer, Outbound, trouble_of
from workers.webhooks.webhook_sender import outcome_of, pause, retry_after

log = logging.getLogger(__name__)

# Time limits until a response's body begins, redirects included, and between two chunks of it.
HEAD_S, IDLE_S = 60.0, 60.0
# A slower host, after a while, only occupies a place.
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
    """A try failed; ``again``: a retry may succeed, after ``wait_s`` at least.

    Without a ``code``, ``detail`` is a predicate of the host, such as "redirects too often".
    """

    def __init__(self, detail: str, *, code: str = "", again: bool = False, wait_s: float = 0.0) -> None:
        self.detail, self.code, self.again, self.wait_s = detail, code, again, wait_s
        super().__init__(detail)

    @classmethod
    def of_trouble(cls, trouble: BaseException) -> TransferFailed:
        """The failure for one of the `TROUBLES` of a request."""
        code, again = trouble_of(trouble)
        return cls(_WHY[code], code="address_refused" if code in _REFUSED else "", again=again)

    @classmethod
    def of_answer(cls, answer: Answer) -> TransferFailed:
        """The failure for an unexpected response."""
        expired = "; a signed address may have expired" if answer.status in {400, 401, 403} else ""
        again = outcome_of(answer.status) == "again"
        wait_s = retry_after(answer)
        return cls(f"answers {answer.status}{expired}", again=again, wait_s=wait_s)

    def error(self, host: str | None, where: str, code: str) -> JobError:
        """The error that the user sees; ``code`` applies if the failure has none."""
        of_host = self.code in {"", "address_refused"}
        return JobError(
            code=self.code or code,
            detail=f"{host} {self.detail}." if of_host else self.detail,
            where=where,
            hint="Check the address, or sign a new one." if of_host else "",
            retryable=self.again,
        )


class TransferWork(LeasedWork):
    """Transfers from or to users' addresses, one file per row; retried while that may help."""

    rounds_max: ClassVar[int]
    # Errors that pass through: they are no failures of the transfer.
    raised: ClassVar[tuple[type[FaultError], ...]] = (Unavailable,)

    def __init__(
        self, database: Database, listener: Listener, outbound: Outbound, settings: Settings
    ) -> None:
        super().__init__(database, listener, settings.poll_s, 2 * settings.beat_s)
        self._outbound, self._settings = outbound, settings

    @abstractmethod
    async def _transfer(self, row: dict[str, Any]) -> None:
        """One try."""

    async def _attempt(self, row: dict[str, Any]) -> TransferFailed | None:
        """Try once; returns the failure, None after success."""
        if row["losses"] >= LOSSES_MAX:
            return TransferFailed(f"was given up: {LOSSES_MAX} processes were lost during the transfer")
        try:
            await self._transfer(row)
        except self.raised:
            raise
        except TransferFailed as failed:
            return failed
        except FaultError as error:  # a limit; a full disk may have room later
            return TransferFailed(error.detail, code=error.code, again=error.code == "storage_full")
        except TROUBLES as trouble:
            return TransferFailed.of_trouble(trouble)
        except Exception:  # our own fault must not repeat forever
            log.exception("the transfer of %s failed", row["id"])
            return TransferFailed("could not be used, by a fault of the service", again=True)
        return None

    async def _comes_again(self, row: dict[str, Any], failed: TransferFailed, round_: int) -> bool:
        """Whether a retry follows this try, which ended round ``round_``; if so, gives the row back."""
        if not failed.again or round_ >= self.rounds_max:
            return False
        wait_s = max(pause(max(round_, 1), self._settings.webhook_retry_s), failed.wait_s)
        await self._give_back(row, round_=round_, wait_s=wait_s)
        return True
