"""The share of the processor that a run got, compared with processor time over wall time of work that never sleeps."""

import os
import signal
import subprocess
import sys
import time

import pytest

from biresnerf.forecast.processor_share import ProcessorShare

pytestmark = pytest.mark.skipif(not os.path.exists("/proc/self/schedstat"), reason="needs Linux's schedstat")
BURN = """
import time
began, end = time.monotonic(), time.process_time() + 1.5
while time.process_time() < end: pass
print(1.5 / (time.monotonic() - began), flush=True)
"""


@pytest.fixture
def busy_core():
    """This process shares one core with another that is not its child."""
    cores = os.sched_getaffinity(0)
    os.sched_setaffinity(0, {min(cores)})
    start = f'{sys.executable} -S -c "while True: pass" >/dev/null & echo $!'
    hog = int(subprocess.run(["sh", "-c", start], stdout=subprocess.PIPE, check=True).stdout)
    yield
    os.kill(hog, signal.SIGKILL)
    os.sched_setaffinity(0, cores)


def test_the_share_is_the_processor_time_over_the_time_that_the_work_took(busy_core):
    share = ProcessorShare()
    with share.watching():
        began, end = time.monotonic(), time.process_time() + 1.5
        while time.process_time() < end:
            pass
        ended = time.monotonic()
    got = 1.5 / (ended - began)
    assert got < 0.75
    assert share.between(began, ended) == pytest.approx(got, abs=0.1)


def test_a_child_that_has_ended_counts(busy_core):
    share = ProcessorShare()
    with share.watching():
        began = time.monotonic()
        code = BURN + "time.sleep(1.2)"  # seen once more, as COLMAP's children are that live for seconds
        said = subprocess.run([sys.executable, "-S", "-c", code], stdout=subprocess.PIPE, check=True).stdout
        ended = time.monotonic()
    assert float(said) < 0.75
    assert share.between(began, ended) == pytest.approx(float(said), abs=0.1)


def test_time_without_work_says_nothing():
    share = ProcessorShare()
    assert share.between(0.0, time.monotonic()) == 1.0
    with share.watching():
        began = time.monotonic()
        time.sleep(0.1)
    assert share.between(began, time.monotonic()) == 1.0
