"""The service's job program for these tests: the real one, made small. Run as `python small_job.py JOB_FOLDER`."""

from __future__ import annotations

import os
import sys
from pathlib import Path

sys.path.insert(0, str(Path(__file__).resolve().parents[2]))

from tests.docs.small_runs import small_runs
from workers.run.job_process import main

if __name__ == "__main__":
    with small_runs():
        status = main(Path(sys.argv[1]))
    sys.stderr.flush()
    os._exit(status)
