"""The client's uploads over connections that break."""

from __future__ import annotations

import hashlib
import os
import threading
import zipfile
from pathlib import Path
from urllib.parse import urlsplit

import httpx
import pytest

from biresnerf.client import Client, LocalFile, ServiceError
from tests.service.client.relay import Relay
from tests.service.conftest import MIB, Running


@pytest.fixture
def relay(service: Running) -> Relay:
    port = urlsplit(service.url).port
    assert port is not None
    return Relay(port)


def cut_after(relay: Relay, *marks: int) -> threading.Thread:
    """Cuts all connections each time so many bytes more have gone to the service."""

    def run() -> None:
        for mark in marks:
            target = relay.sent + mark
            while relay.sent < target:
                over.wait(0.001)
            relay.cut()

    over = threading.Event()
    thread = threading.Thread(target=run, daemon=True)
    thread.start()
    return thread


def stored(http: httpx.Client, dataset: str) -> dict[str, str]:
    items = http.get(f"/v1/datasets/{dataset}/files").json()["items"]
    return {item["path"]: item["sha256"] for item in items}


def test_an_archive_gets_through_three_cuts_and_little_is_sent_twice(
    http: httpx.Client, relay: Relay, tmp_path: Path
) -> None:
    content = {f"images/{i}.bin": os.urandom(MIB) for i in range(5)}
    with zipfile.ZipFile(tmp_path / "set.zip", "w") as archive:
        for name, data in content.items():
            archive.writestr(name, data)
    cutting = cut_after(relay, MIB, MIB, MIB)
    with Client(f"http://127.0.0.1:{relay.port}") as client:
        dataset = client.create_dataset("cut")
        client.send_archive(dataset, tmp_path / "set.zip")
    cutting.join(10)
    assert not cutting.is_alive()
    assert stored(http, dataset.id) == {
        name: hashlib.sha256(data).hexdigest() for name, data in content.items()
    }


def test_files_get_through_a_cut_and_the_second_time_nothing_is_sent(
    http: httpx.Client, relay: Relay, tmp_path: Path
) -> None:
    for number in range(6):
        (tmp_path / f"{number} ü.bin").write_bytes(os.urandom(MIB))
    files = [LocalFile.at(f"images/{path.name}", path) for path in sorted(tmp_path.iterdir())]
    cutting = cut_after(relay, 2 * MIB)
    with Client(f"http://127.0.0.1:{relay.port}") as client:
        dataset = client.create_dataset("cut", [file.entry for file in files])
        assert client.send_missing(dataset, files) == 6
        cutting.join(10)
        assert not cutting.is_alive()
        assert stored(http, dataset.id) == {file.name: file.sha256 for file in files}
        again = client.create_dataset("again", [file.entry for file in files])
        before = relay.sent
        assert client.send_missing(again, files) == 0
        assert relay.sent - before < 10_000
    assert stored(http, again.id) == {file.name: file.sha256 for file in files}


def test_what_the_service_refuses_ends_the_sending_at_once(relay: Relay, tmp_path: Path) -> None:
    (tmp_path / "large").write_bytes(bytes(3 * MIB))
    (tmp_path / "changed").write_bytes(b"before")
    large, changed = (LocalFile.at(name, tmp_path / name) for name in ("large", "changed"))
    (tmp_path / "changed").write_bytes(b"after!")
    with Client(f"http://127.0.0.1:{relay.port}") as client:
        for file, code in ((large, "body_too_large"), (changed, "digest_mismatch")):
            dataset = client.create_dataset("refused", [file.entry])
            with pytest.raises(ServiceError) as caught:
                client.send_missing(dataset, [file])
            assert caught.value.code == code


def test_a_service_that_stays_away_is_given_up(relay: Relay, tmp_path: Path) -> None:
    (tmp_path / "a").write_bytes(b"a")
    file = LocalFile.at("a", tmp_path / "a")
    with Client(f"http://127.0.0.1:{relay.port}", patience_s=0.5) as client:
        dataset = client.create_dataset("away", [file.entry])
        relay.close()
        with pytest.raises(ServiceError) as caught:
            client.send_missing(dataset, [file])
    assert caught.value.code == "unreachable"
