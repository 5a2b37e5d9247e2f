"""A child program that reports its environment and limits, or never ends."""

from __future__ import annotations

import os
import resource
import time
from typing import Any

from service.intake.sandboxed_child import run_child


def _work(request: dict[str, Any]) -> dict[str, Any]:
    if request["does"] == "wait":
        time.sleep(60)
    limits = {name: resource.getrlimit(getattr(resource, name))[0] for name in ("RLIMIT_AS", "RLIMIT_FSIZE")}
    return {"variables": sorted(os.environ), "limits": limits}


if __name__ == "__main__":
    run_child(_work)
