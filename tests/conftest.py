"""What holds for all tests."""

from __future__ import annotations

import signal

from biresnerf.openmp import let_waiting_threads_sleep

# A shell ignores Ctrl-C on behalf of what it runs in the background, and that is inherited: the processes that tests
# start and interrupt must be able to hear it wherever the tests themselves run.
if signal.getsignal(signal.SIGINT) == signal.SIG_IGN:
    signal.signal(signal.SIGINT, signal.default_int_handler)

let_waiting_threads_sleep()
