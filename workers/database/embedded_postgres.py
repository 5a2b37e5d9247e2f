"""A private PostgreSQL as a child process of ours: no port, no password, no configuration.

Only the programs come from a wheel. Its Python layer is not used: it trusts ``postmaster.pid`` blindly, and
after a power cut the PID in it can belong to an unrelated process.
"""

from __future__ import annotations

import fcntl
import hashlib
import logging
import os
import pwd
import shutil
import signal
import subprocess
import tempfile
import time
from pathlib import Path
from typing import IO
from urllib.parse import quote

import psutil
import psycopg

from workers.database.postgres_binaries import (
    find_binaries,
    reachable,
    readable_binaries,
    server_version,
    unprivileged_user,
)
from workers.process.die_with_parent import dying_with_parent
from workers.settings.errors import SetupError

log = logging.getLogger(__name__)

SOCKET_NAME = ".s.PGSQL.5432"
SOCKET_PATH_MAX = 107  # bytes; sockaddr_un.sun_path without its final zero
LOG_BYTES_MAX = 10 * 2**20
STOP_S = 30.0
NETWORK_FILE_SYSTEMS = {"nfs", "nfs4", "cifs", "smb3", "smbfs", "9p", "fuse.sshfs", "ceph", "glusterfs"}
SERVER_OPTIONS = {
    "listen_addresses": "",
    "unix_socket_permissions": "0700",  # authentication is trust: the socket's rights are the guard
    "shared_buffers": "32MB",
    "max_parallel_workers": "0",
    "dynamic_shared_memory_type": "mmap",  # containers often have a tiny /dev/shm
    "log_min_messages": "warning",
}


class EmbeddedPostgres:
    """One PostgreSQL cluster under ``root``, run by at most one process at a time.

    Call ``start`` again after it died, and ``stop`` at the end. It shuts down when this process dies.
    It accepts ``connections`` at a time.
    """

    def __init__(self, root: Path, *, pg_bin: Path | None = None, connections: int = 100) -> None:
        self.user = unprivileged_user()
        self.root = self._reachable_root(root)
        self.data = self.root / "data"
        self.sockets = self._socket_folder()
        self.url = f"postgresql://postgres@/postgres?host={quote(str(self.sockets), safe='')}"
        self.process: subprocess.Popen[bytes] | None = None
        self._pg_bin, self._connections = pg_bin, connections
        self._lock: IO[str] | None = None

    def start(self, *, timeout_s: float = 60.0) -> str:
        """Start the server (creating the cluster the first time) and return its address once it answers.

        Raises `SetupError`: no programs, the folder is in use or unsuitable, or the server does not come up (with the
        end of its log).
        """
        self._take_lock()
        self._refuse_network_folder()
        binaries = readable_binaries(find_binaries(self._pg_bin), self.user, self.root)
        self._create_cluster(binaries)
        self._check_version(binaries)
        self._clear_remains()
        chosen = {**SERVER_OPTIONS, "max_connections": str(self._connections)}
        options = [part for name, value in chosen.items() for part in ("-c", f"{name}={value}")]
        command = [str(binaries / "postgres"), "-D", str(self.data), "-k", str(self.sockets), *options]
        with self._open_log() as output:
            self.process = subprocess.Popen(
                dying_with_parent(
                    command, signal_number=signal.SIGINT, user=self.user
                ),  # SIGINT: fast shutdown
                stdin=subprocess.DEVNULL,
                stdout=output,
                stderr=output,
                cwd=self.root,
                start_new_session=True,
            )
        self._wait_until_it_answers(timeout_s)
        return self.url

    @property
    def alive(self) -> bool:
        """Whether the server process runs."""
        return self.process is not None and self.process.poll() is None

    def stop(self) -> None:
        """Fast shutdown, then free the folder for others."""
        if self.process is not None and self.process.poll() is None:
            self.process.send_signal(signal.SIGINT)
            try:
                self.process.wait(STOP_S)
            except subprocess.TimeoutExpired:
                self.process.send_signal(signal.SIGQUIT)  # recovery at the next start
                self.process.wait(STOP_S)
        if self._lock is not None:
            self._lock.close()
            self._lock = None

    def _reachable_root(self, root: Path) -> Path:
        root = root.absolute()
        try:
            root.mkdir(parents=True, exist_ok=True, mode=0o700)
        except OSError as error:
            raise SetupError(
                "folder_unusable", f"Cannot create {root}: {error.strerror}. Set BIRESNERF_DATA_DIR."
            ) from error
        root = root.resolve()
        if self.user is None or reachable(root.parent, self.user, only_pass=True):
            return root
        # As root with a data folder below a private one such as /root: the server's user cannot get there.
        name = hashlib.sha256(str(root).encode()).hexdigest()[:12]
        elsewhere = Path("/var/lib/biresnerf-postgres") / name
        log.warning("user %s cannot reach %s; the private database lies in %s", self.user, root, elsewhere)
        elsewhere.mkdir(parents=True, exist_ok=True, mode=0o755)
        return elsewhere

    def _socket_folder(self) -> Path:
        if len(str(self.root / SOCKET_NAME).encode()) <= SOCKET_PATH_MAX:
            return self.root
        name = hashlib.sha256(str(self.root).encode()).hexdigest()[:12]
        base = os.environ.get("XDG_RUNTIME_DIR") if self.user is None else None
        return Path(base or tempfile.gettempdir()) / f"biresnerf-{name}"

    def _take_lock(self) -> None:
        if self._lock is not None:
            return
        try:
            lock = (self.root / "lock").open("a")
        except OSError as error:
            raise SetupError(
                "folder_unusable", f"Cannot write to {self.root}: {error.strerror}. Set BIRESNERF_DATA_DIR."
            ) from error
        try:
            fcntl.flock(lock, fcntl.LOCK_EX | fcntl.LOCK_NB)  # the kernel frees it, however we die
        except BlockingIOError:
            lock.close()
            raise SetupError(
                "already_running",
                f"Another process runs the private database in {self.root}. "
                "Stop it, or give this one its own BIRESNERF_DATA_DIR.",
            ) from None
        self._lock = lock
        for folder in {self.root, self.sockets}:
            self._make_private(folder)

    def _make_private(self, folder: Path) -> None:
        """``folder`` as 0700 of the server's user; refuses one that somebody else put there."""
        uid = pwd.getpwnam(self.user).pw_uid if self.user else os.geteuid()
        folder.mkdir(exist_ok=True, mode=0o700)
        info = folder.lstat()
        if folder.is_symlink() or info.st_uid not in (uid, os.geteuid()):
            raise SetupError("unsafe_folder", f"{folder} belongs to somebody else. Remove it.")
        if info.st_uid != uid:
            os.chown(folder, uid, -1)
        folder.chmod(0o700)

    def _refuse_network_folder(self) -> None:
        mounts = [
            part for part in psutil.disk_partitions(all=True) if self.root.is_relative_to(part.mountpoint)
        ]
        kind = max(mounts, key=lambda part: len(part.mountpoint)).fstype if mounts else ""
        if kind in NETWORK_FILE_SYSTEMS:
            raise SetupError(
                "network_folder",
                f"{self.root} lies on a network file system ({kind}), where a database is not safe. "
                "Set BIRESNERF_DATA_DIR to a local disk, or BIRESNERF_DATABASE_URL.",
            )

    def _create_cluster(self, binaries: Path) -> None:
        if (self.data / "PG_VERSION").exists():
            return
        if self.data.exists() and any(self.data.iterdir()):
            raise SetupError(
                "unknown_folder", f"{self.data} holds something that is no database. Move it away."
            )
        building = self.root / "data.init"
        shutil.rmtree(building, ignore_errors=True)
        arguments = ("-A", "trust", "-U", "postgres", "-E", "UTF8", "--locale=C", "-D", str(building))
        made = subprocess.run(
            dying_with_parent(
                [str(binaries / "initdb"), *arguments], signal_number=signal.SIGKILL, user=self.user
            ),
            capture_output=True,
            text=True,
            cwd=self.root,
        )
        if made.returncode != 0:
            raise SetupError("initdb_failed", f"initdb failed in {self.root}: {made.stderr.strip()[-800:]}")
        building.rename(self.data)

    def _check_version(self, binaries: Path) -> None:
        have = (self.data / "PG_VERSION").read_text().strip()
        server = server_version(binaries).split(".")[0]
        if have != server:
            raise SetupError(
                "database_version",
                f"The database in {self.data} is of PostgreSQL {have}, the programs are {server}. "
                f"Dump it with PostgreSQL {have} (pg_dumpall) and load it into a fresh folder, "
                "or set BIRESNERF_PG_BIN.",
            )

    def _clear_remains(self) -> None:
        """Wait for a killed predecessor's servers to end; delete a ``postmaster.pid`` that names another process.

        If its process no longer exists, the file stays: PostgreSQL then checks whether anything is still attached to
        the old shared memory.
        """
        end = time.monotonic() + 20
        while ours := self._own_servers():
            late = time.monotonic() > end
            for process in ours:
                try:
                    # A predecessor's death has already sent SIGINT; ending backends need only time.
                    process.send_signal(signal.SIGKILL if late else signal.SIGINT)
                except psutil.NoSuchProcess:
                    continue
            psutil.wait_procs(ours, timeout=1)
        file = self.data / "postmaster.pid"
        try:
            pid = int(file.read_text().split()[0])
        except FileNotFoundError:
            return
        except (ValueError, IndexError):
            file.unlink()  # torn by a power cut; no server of this cluster is running, see above
            return
        if psutil.pid_exists(pid):
            log.warning("postmaster.pid names process %d, which is not our server; removing it", pid)
            file.unlink()

    def _own_servers(self) -> list[psutil.Process]:
        """Server processes that run in our data folder (the postmaster and its backends)."""
        found = []
        for process in psutil.process_iter(["name", "status"]):
            if not (process.info["name"] or "").startswith("postgres"):
                continue
            if process.info["status"] == psutil.STATUS_ZOMBIE:
                continue
            try:
                if Path(process.cwd()) == self.data:
                    found.append(process)
            except psutil.Error:
                continue
        return found

    def _open_log(self) -> IO[bytes]:
        path = self.root / "log"
        keep = path.exists() and path.stat().st_size < LOG_BYTES_MAX
        return path.open("ab" if keep else "wb")

    def _wait_until_it_answers(self, timeout_s: float) -> None:
        end = time.monotonic() + timeout_s
        while True:
            try:
                psycopg.connect(self.url, connect_timeout=2).close()
                return
            except psycopg.OperationalError as error:
                if self.alive and time.monotonic() < end:
                    time.sleep(0.03)
                    continue
                tail = (self.root / "log").read_text(errors="replace")[-1200:].strip()
                raise SetupError(
                    "database_did_not_start", f"The private database did not start ({error}). {tail}"
                ) from error
