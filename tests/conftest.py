"""What holds for all tests: Ctrl-C, threads, markers by what a test needs, and which skips are expected."""

from __future__ import annotations

import os
import re
import signal
from collections import Counter

import pytest

from biresnerf.errors import FAULTS_RAISE
from biresnerf.openmp import let_waiting_threads_sleep

# A shell ignores Ctrl-C on behalf of what it runs in the background, and that is inherited. The processes that tests
# start and interrupt must hear it wherever the tests run.
if signal.getsignal(signal.SIGINT) == signal.SIG_IGN:
    signal.signal(signal.SIGINT, signal.default_int_handler)

let_waiting_threads_sleep()
os.environ[FAULTS_RAISE] = "1"  # no test must pass on the evidence that is left

# A test that uses one of these fixtures, directly or not, needs what the marker says.
MARKERS_OF_FIXTURES = {
    "server": {"service", "closed", "server", "slots", "moto"},
    "browser": {"browser"},
}
# `make test-nightly` runs what lies here, so that `make test` stays short enough to be run before each commit.
NIGHTLY = (
    "tests/deploy/",
    "tests/docs/test_documented_commands.py",
    "tests/docs/test_notebooks.py",
    "tests/docs/test_typescript.py",
    "tests/field/cuda/",
    "tests/service/test_fuzz.py",
    "tests/studies/commands/",
    "tests/test_benchmarks.py",
    "tests/test_run_benchmarks.py",
    "tests/workers/queue/promises/",
)
FIRST_PAGES = ("[README.md]", "[docs/quick-start.md]")  # whose commands every newcomer runs
# Why a test may be skipped on a machine that has all that CI installs: any other skip fails `--unexpected-skips-fail`.
EXPECTED_SKIPS = (
    r"torch finds none",
    r"set BIRESNERF_TEST_PYCOLMAPS",
    r"set BIRESNERF_TEST_INSTALL",
    r"set BIRESNERF_TEST_DATA to the folder that holds it",
    r"other programs' readers are run by make consumers-check",
    r"no source of .*: set BIRESNERF_CONSUMER_SOURCES",
    r"npm cannot install",
    r"no zip program writes",
    r"promtool is not installed",
    r"only root can make a disk read-only",
    r"nginx is not installed",
    r"all was sent before the signal came",
    r"the Kubernetes manifests are not rendered",
    r"Slurm is run by make slurm-check",
    r"there is no second disk",
)


@pytest.fixture(scope="session", autouse=True)
def _cache_of_its_own(tmp_path_factory: pytest.TempPathFactory) -> None:
    """What runs of tiny sets measure must not become what this machine expects of its user's runs."""
    os.environ["XDG_CACHE_HOME"] = str(tmp_path_factory.mktemp("cache"))


def pytest_addoption(parser: pytest.Parser) -> None:
    parser.addoption(
        "--unexpected-skips-fail",
        action="store_true",
        help="Fail if a test was skipped for a reason not foreseen.",
    )


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    for item in items:
        fixtures = set(getattr(item, "fixturenames", ()))
        for marker, names in MARKERS_OF_FIXTURES.items():
            if fixtures & names:
                item.add_marker(marker)
        if item.nodeid.startswith(NIGHTLY) and not item.nodeid.endswith(FIRST_PAGES):
            item.add_marker("nightly")
    # Files of long tests first, or one process is left with them while the others have nothing to do.
    long = {item.path for item in items if any(item.get_closest_marker(name) for name in ("browser", "slow"))}
    items.sort(key=lambda item: item.path not in long)


def _skips(config: pytest.Config) -> tuple[int, Counter[str]]:
    """How many tests were skipped, and the reasons that `EXPECTED_SKIPS` does not foresee."""
    reporter = config.pluginmanager.get_plugin("terminalreporter")
    reports = reporter.stats.get("skipped", ()) if reporter else ()
    reasons = [str(report.longrepr[2]).removeprefix("Skipped: ") for report in reports]
    return len(reasons), Counter(r for r in reasons if not any(re.search(e, r) for e in EXPECTED_SKIPS))


def pytest_sessionfinish(session: pytest.Session) -> None:
    unexpected = _skips(session.config)[1] if session.config.getoption("unexpected_skips_fail") else None
    if unexpected:
        # Kept for CI, as running failed tests again forgets them.
        session.config.cache.set("biresnerf/unexpected_skips", unexpected)
        if session.exitstatus == pytest.ExitCode.OK:
            session.exitstatus = pytest.ExitCode.TESTS_FAILED


def _write_time_by_file(terminalreporter: pytest.TerminalReporter) -> None:
    """The files that took longest: what to shorten first."""
    seconds: Counter[str] = Counter()
    for reports in terminalreporter.stats.values():
        for report in reports:
            if isinstance(report, pytest.TestReport):
                seconds[report.nodeid.partition("::")[0]] += report.duration  # type: ignore[assignment]
    terminalreporter.section("seconds by file")
    for file, spent in seconds.most_common(terminalreporter.config.getoption("durations")):
        terminalreporter.write_line(f"{spent:8.1f} {file}")


def pytest_terminal_summary(terminalreporter: pytest.TerminalReporter, config: pytest.Config) -> None:
    if config.getoption("durations"):
        _write_time_by_file(terminalreporter)
    skipped, unexpected = _skips(config)
    if skipped:
        terminalreporter.write_line(f"{skipped} skipped, {unexpected.total()} of them unexpectedly")
    for reason, count in unexpected.items():
        terminalreporter.write_line(f"  {count} x {reason}", red=True)
