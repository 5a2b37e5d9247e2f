"""What a link to a job's page opens: reading that job, without its log and its owner's names."""

from __future__ import annotations

import re
from typing import Any

from biresnerf.wire.jobs import JobView
from service.http.problems import ProblemError

LINK_PREFIX = "brl_"
_SHOWN = re.compile(r"(/(artifacts|artifacts/(?!log\.txt$).+|report|link))?", re.DOTALL)


def require_shown(job_id: str, method: str, path: str) -> None:
    """Raises ``ProblemError`` (``not_found``) unless a link to the job allows this request."""
    base = f"/v1/jobs/{job_id}"
    shown = path.startswith(base) and _SHOWN.fullmatch(path[len(base) :])
    if method not in ("GET", "HEAD") or not shown:
        raise ProblemError("not_found", "The link does not open this address.")


def shown_to_strangers(job: JobView) -> JobView:
    """The job without its tenant, key, labels, dataset, deliveries, and the jobs that it was made from."""
    links = job.links.model_copy(update={"dataset": ""})
    owners: dict[str, Any] = {"tenant": "", "key_id": None, "labels": {}, "dataset_id": "", "links": links}
    owners["delivered"] = ()
    others = dict.fromkeys(("parent", "forked_from", "fixed_from", "batch_id"))
    return job.model_copy(update={**owners, **others})
