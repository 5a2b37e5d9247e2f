"""A large set through broken connections and killed servers, in constant memory: `python -m benchmarks.service.upload`.

Sends it twice through a relay that cuts the connections at fixed shares of the way, and kills the API process
(SIGKILL) at others: once as one archive over a resumable upload, once file by file. Then reads every file back
from the store and compares it with what was sent.
"""

from __future__ import annotations

import argparse
import hashlib
import json
import os
import shutil
import socket
import struct
import subprocess
import sys
import tempfile
import threading
import time
import zipfile
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path
from typing import Any

import psutil
import psycopg

from biresnerf.client import Client, LocalFile
from workers.database.embedded_postgres import EmbeddedPostgres
from workers.database.migrate import migrate

MIB = 2**20
CUTS = (0.12, 0.33, 0.47, 0.71, 0.9)
KILLS = (0.22, 0.55, 0.8)
PATIENCE_S = 300.0


class Relay:
    """Passes connections on to the service, counts what goes there, and cuts them all when told to."""

    def __init__(self, target_port: int) -> None:
        self._target = target_port
        self._listener = socket.create_server(("127.0.0.1", 0))
        self.port: int = self._listener.getsockname()[1]
        self.sent = 0
        self._open: set[socket.socket] = set()
        threading.Thread(target=self._accept, daemon=True).start()

    def _accept(self) -> None:
        while True:
            try:
                here, _ = self._listener.accept()
            except OSError:  # closed
                return
            try:
                there = socket.create_connection(("127.0.0.1", self._target))
            except OSError:  # the service is down
                here.close()
                continue
            self._open |= {here, there}
            for source, sink, counted in ((here, there, True), (there, here, False)):
                threading.Thread(target=self._pump, args=(source, sink, counted), daemon=True).start()

    def _pump(self, source: socket.socket, sink: socket.socket, counted: bool) -> None:
        try:
            while data := source.recv(256 * 1024):
                sink.sendall(data)
                if counted:
                    self.sent += len(data)
        except OSError:
            pass  # cut, here or there
        for end in (source, sink):
            self._open.discard(end)
            with suppress(OSError):  # not connected any more
                end.shutdown(socket.SHUT_RDWR)  # wakes the other direction, which `close` alone would not
            end.close()

    def cut(self) -> None:
        """Every connection ends as if the cable were pulled: reset, without a goodbye."""
        for end in list(self._open):
            try:
                end.setsockopt(socket.SOL_SOCKET, socket.SO_LINGER, struct.pack("ii", 1, 0))
                end.shutdown(socket.SHUT_RDWR)
            except OSError:
                continue  # it ended by itself

    def close(self) -> None:
        """Nobody gets through any more."""
        self._listener.shutdown(socket.SHUT_RDWR)
        self._listener.close()
        self.cut()


class Api:
    """The API process, at one port for all its lives."""

    def __init__(self, folder: Path, database_url: str, set_bytes: int) -> None:
        with socket.socket() as probe:
            probe.bind(("127.0.0.1", 0))
            self.port: int = probe.getsockname()[1]
        self._log = folder / "api.log"
        self._environment = {
            **os.environ,
            "BIRESNERF_DATABASE_URL": database_url,
            "BIRESNERF_DATA_DIR": str(folder / "data"),
            "BIRESNERF_PORT": str(self.port),
            "BIRESNERF_MAX_DATASET_BYTES": str(2 * set_bytes),
            "BIRESNERF_MAX_ARCHIVE_BYTES": str(2 * set_bytes),
        }
        self.peak_mib = 0.0
        self.idle_mib = 0.0
        self.process: subprocess.Popen[bytes] | None = None
        threading.Thread(target=self._watch, daemon=True).start()

    def start(self) -> None:
        """Starts it and waits until it answers."""
        with self._log.open("ab") as log:
            self.process = subprocess.Popen(
                [sys.executable, "-m", "service.server"], env=self._environment, stdout=log, stderr=log
            )
        with Client(f"http://127.0.0.1:{self.port}") as client:
            end = time.monotonic() + PATIENCE_S
            while not client.ready():
                if time.monotonic() > end:
                    raise SystemExit(self._log.read_text())
                time.sleep(0.1)
        self.idle_mib = self.idle_mib or self._resident()

    def kill(self) -> None:
        """SIGKILL."""
        if self.process is not None:
            self.process.kill()
            self.process.wait()

    def _resident(self) -> float:
        process = self.process
        try:
            return psutil.Process(process.pid).memory_info().rss / MIB if process else 0.0
        except psutil.Error:
            return 0.0

    def _watch(self) -> None:
        while True:
            self.peak_mib = max(self.peak_mib, self._resident())
            time.sleep(0.02)


class Faults:
    """Cuts and kills, each when its share of the bytes has passed the relay."""

    def __init__(self, api: Api, relay: Relay, set_bytes: int) -> None:
        self._api, self._relay = api, relay
        begun = relay.sent
        due = [(share, relay.cut) for share in CUTS] + [(share, self._kill) for share in KILLS]
        self._due: list[tuple[int, Callable[[], None]]] = sorted(
            ((begun + int(share * set_bytes), fault) for share, fault in due), key=lambda pair: pair[0]
        )
        self._over = threading.Event()
        self.thread = threading.Thread(target=self._run)
        self.thread.start()

    def _kill(self) -> None:
        self._api.kill()
        self._api.start()

    def _run(self) -> None:
        for at, fault in self._due:
            while self._relay.sent < at:
                if self._over.wait(0.002):
                    return
            fault()

    def end(self) -> int:
        """Waits for a fault under way; returns how many should have come but did not."""
        missed = sum(self._relay.sent < at for at, _ in self._due)
        self._over.set()
        self.thread.join()
        return missed


def make_set(folder: Path, total_bytes: int) -> tuple[Path, list[LocalFile]]:
    """Files of noise from 1 to 24 MiB, and one archive of them."""
    (folder / "images").mkdir(parents=True)
    files, made = [], 0
    while made < total_bytes:
        name = f"images/{len(files):04d}.bin"
        size = min((1 + 7 * len(files) % 24) * MIB, total_bytes - made)
        (folder / name).write_bytes(os.urandom(size))
        files.append(LocalFile.at(name, folder / name))
        made += size
    with zipfile.ZipFile(folder / "set.zip", "w") as archive:
        for file in files:
            archive.write(file.path, file.name)
    return folder / "set.zip", files


def stored_as_sent(database_url: str, store: Path, dataset_id: str, files: list[LocalFile]) -> bool:
    """Whether the store holds exactly these files, byte for byte."""
    with psycopg.connect(database_url) as connection:
        rows = connection.execute(
            "SELECT path, key FROM dataset_files WHERE dataset_id = %s", (dataset_id,)
        ).fetchall()
    found = {}
    for path, key in rows:
        with (store / key).open("rb") as file:
            found[path] = hashlib.file_digest(file, "sha256").hexdigest()
    return found == {file.name: file.sha256 for file in files}


def measure(
    how: str, api: Api, relay: Relay, send: Callable[[Client], str], check: Callable[[str], bool], size: int
) -> dict[str, Any]:
    """One way of sending, under faults."""
    api.peak_mib = 0.0
    sent_before, began = relay.sent, time.monotonic()
    faults = Faults(api, relay, size)
    with Client(f"http://127.0.0.1:{relay.port}", patience_s=PATIENCE_S) as client:
        dataset_id = send(client)
    seconds = time.monotonic() - began
    missed = faults.end()
    row = {
        "how": how,
        "bytes": size,
        "seconds": round(seconds, 1),
        "cuts and kills": len(CUTS) + len(KILLS) - missed,
        "sent twice": round((relay.sent - sent_before - size) / size, 4),
        "idle MiB": round(api.idle_mib),
        "peak MiB": round(api.peak_mib),
        "identical": check(dataset_id),
    }
    print(json.dumps(row), flush=True)
    return row


def run(total_bytes: int, folder: Path) -> list[dict[str, Any]]:
    """Both ways; the rows of the table."""
    archive, files = make_set(folder / "set", total_bytes)
    postgres = EmbeddedPostgres(folder / "postgres")
    url = postgres.start()
    migrate(url)
    api = Api(folder, url, total_bytes)
    api.start()
    relay = Relay(api.port)

    def as_archive(client: Client) -> str:
        dataset = client.create_dataset("archive")
        client.send_archive(dataset, archive)
        return dataset.id

    def as_files(client: Client) -> str:
        dataset = client.create_dataset("files", [file.entry for file in files])
        client.send_missing(dataset, files)
        return dataset.id

    def check(dataset_id: str) -> bool:
        return stored_as_sent(url, folder / "data/files", dataset_id, files)

    try:
        # Other bytes for the second way: the service would know those of the first by their digests.
        first = measure("one archive", api, relay, as_archive, check, archive.stat().st_size)
        shutil.rmtree(folder / "set")
        _, files = make_set(folder / "set", total_bytes)
        return [first, measure("file by file", api, relay, as_files, check, total_bytes)]
    finally:
        api.kill()
        postgres.stop()


def main() -> int:
    parser = argparse.ArgumentParser(prog="python -m benchmarks.service.upload", description=__doc__)
    parser.add_argument("--bytes", type=int, default=2_000_000_000)
    parser.add_argument(
        "--folder", type=Path, help="where to work; needs five times the bytes (default: /tmp)"
    )
    asked = parser.parse_args()
    folder = Path(tempfile.mkdtemp(prefix="biresnerf-upload-", dir=asked.folder))
    folder.chmod(0o711)  # PostgreSQL's user must get through
    try:
        rows = run(asked.bytes, folder)
    finally:
        shutil.rmtree(folder, ignore_errors=True)
    good = all(row["identical"] and row["cuts and kills"] == len(CUTS) + len(KILLS) for row in rows)
    return 0 if good else 1


if __name__ == "__main__":
    sys.exit(main())
