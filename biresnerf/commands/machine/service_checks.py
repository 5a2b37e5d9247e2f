"""The checks of `biresnerf doctor --service`: a running installation, seen from outside."""

from __future__ import annotations

import contextlib
import ipaddress
import socket
import ssl
import tempfile
import time
from collections.abc import Callable, Iterator
from email.utils import parsedate_to_datetime
from functools import partial
from pathlib import Path

import httpx
from PIL import Image
from pydantic import ValidationError

from biresnerf import __version__
from biresnerf.client import Client, ServiceError
from biresnerf.client.uploads import LocalFile
from biresnerf.commands.machine.machine_checks import Found
from biresnerf.wire.problems import Problem
from biresnerf.wire.service import Health, Info

ANSWER_S = 10.0
CLOCK_OFF_S = 30.0
CERTIFICATE_DAYS = 14.0  # automatic renewal happens long before
WRITES = "datasets:write"
PICTURES = 3


def service_checks(url: str, api_key: str | None) -> Iterator[Found]:
    """What can be seen of the service at ``url``, one finding after the other; ends where nothing more can be seen.

    A small set is uploaded, checked and deleted again, where the key permits it.
    """
    try:
        with (
            Client(url, api_key=api_key, patience_s=0.0) as client,
            httpx.Client(base_url=url, timeout=ANSWER_S) as http,
        ):
            reached = _reached(http)
            yield reached
            if reached.state == "broken":
                return
            for name, check in (
                *(("TLS", _encryption), ("ready", _readiness)),
                *(("clock", _clock), ("metrics", _metrics)),
            ):
                yield _guarded(name, partial(check, http))
            yield from _as_client(client, api_key)
    except ServiceError as error:
        yield Found("reachable", "broken", error.detail, "Give an address such as https://poses.example.org.")


def _guarded(name: str, check: Callable[[], Found]) -> Found:
    try:
        return check()
    except ServiceError as error:
        return Found(
            name, "broken", f"{error.detail} ({error.code})", error.hint or "Look at the service's log."
        )
    except (httpx.HTTPError, OSError) as error:
        said = str(error) or type(error).__name__
        return Found(name, "broken", said, "It answered before: look at the service's log, and the proxy's.")


def _reached(http: httpx.Client) -> Found:
    try:
        answer = http.get("/livez")
        Health.model_validate_json(answer.content)
    except httpx.TransportError as error:
        if "CERTIFICATE" in str(error):
            hint = "Renew it, or use the name it was made for; SSL_CERT_FILE names an authority of your own."
            return Found("TLS", "broken", f"the certificate is refused: {error}", hint)
        hint = "Check address, port and firewall, and that an API process runs."
        return Found("reachable", "broken", str(error) or type(error).__name__, hint)
    except ValidationError:
        hint = "Another program answers there, or a proxy whose service is down."
        if answer.has_redirect_location:
            hint = f"It leads to {answer.headers['location']}: use that address."
        return Found(
            "reachable", "broken", f"/livez answers {answer.status_code}, not as BiResNeRF does", hint
        )
    took_ms = answer.elapsed.total_seconds() * 1000
    return Found("reachable", "good", f"{http.base_url} in {took_ms:.0f} ms")


def _encryption(http: httpx.Client) -> Found:
    url = http.base_url
    if url.scheme == "https":
        days = _certificate_days(url.host, url.port or 443)
        detail = f"the certificate is valid for {days:.0f} days"
        good = days >= CERTIFICATE_DAYS
        return Found("TLS", "good" if good else "broken", detail, "" if good else "Renew the certificate.")
    if _is_loopback(url.host):
        return Found("TLS", "good", "not needed: the address is this machine's alone")
    hint = "Put TLS in front of it: docs/deployment.md."
    return Found("TLS", "broken", "none: keys and photos can be read on their way", hint)


def _certificate_days(host: str, port: int) -> float:
    with (
        socket.create_connection((host, port), ANSWER_S) as plain,
        httpx.create_ssl_context().wrap_socket(plain, server_hostname=host) as line,
    ):
        certificate = line.getpeercert() or {}
    return (ssl.cert_time_to_seconds(str(certificate["notAfter"])) - time.time()) / 86400


def _readiness(http: httpx.Client) -> Found:
    answer = http.get("/readyz")
    if answer.status_code == 200:
        return Found("ready", "good", "database, file store and queue answer")
    try:
        problem = Problem.model_validate_json(answer.content, extra="ignore")
    except ValidationError:
        return Found("ready", "broken", f"/readyz answers {answer.status_code}", "Look at the proxy's log.")
    detail = "; ".join(f"{item.pointer.rpartition('/')[2]}: {item.detail}" for item in problem.errors)
    return Found("ready", "broken", detail or problem.detail, problem.hint or "docs/operations.md, Alerts.")


def _clock(http: httpx.Client) -> Found:
    before = time.time()
    answer = http.get("/livez")
    here = (before + time.time()) / 2
    try:
        # The header has whole seconds, of which half a second have passed on average.
        off_s = parsedate_to_datetime(answer.headers["date"]).timestamp() + 0.5 - here
    except (KeyError, ValueError):
        return Found("clock", "missing", "the answer carries no date", "A proxy takes it away.")
    detail = f"{abs(off_s):.0f} s {'ahead of' if off_s > 0 else 'behind'} this machine's"
    if abs(off_s) <= CLOCK_OFF_S:
        return Found("clock", "good", detail)
    return Found("clock", "broken", detail, "Set both by NTP: keys and links expire by the clock.")


def _metrics(http: httpx.Client) -> Found:
    answer = http.get("/metrics")
    if answer.status_code != 200:
        return Found("metrics", "good", f"closed to outsiders ({answer.status_code})")
    if _is_loopback(http.base_url.host):
        return Found("metrics", "good", "open, to this machine alone")
    return Found(
        "metrics", "broken", "open to everybody", "Set BIRESNERF_METRICS_TOKEN and BIRESNERF_AUTH=required."
    )


def _as_client(client: Client, api_key: str | None) -> Iterator[Found]:
    try:
        info = client.info()
    except ServiceError as error:
        hint = error.hint or "Make a key with `biresnerf keys create`, and pass it in BIRESNERF_API_KEY."
        yield Found("key", "broken", f"{error.detail} ({error.code})", hint)
        return
    yield _key(info, api_key, client.url)
    yield _version(info)
    yield _workers(info)
    yield _room(info)
    if WRITES in info.scopes:
        yield _guarded("upload", partial(_upload, client))
    else:
        yield Found(
            "upload", "missing", "not tried: the key may not write", f"Use a key with the scope {WRITES}."
        )


def _key(info: Info, api_key: str | None, url: str) -> Found:
    detail = f"tenant {info.share.id}, scopes {', '.join(info.scopes)}"
    if api_key is not None:
        return Found("key", "good", detail)
    if _is_loopback(httpx.URL(url).host):
        return Found("key", "good", f"not needed on this machine: {detail}")
    hint = "Set BIRESNERF_AUTH=required, and make keys: biresnerf keys create."
    return Found("key", "broken", f"none is needed: everybody who reaches it is {detail}", hint)


def _version(info: Info) -> Found:
    if info.version == __version__:
        return Found("version", "good", info.version)
    hint = f"pip install biresnerf=={info.version}"
    return Found("version", "missing", f"{info.version}; this client is {__version__}", hint)


def _workers(info: Info) -> Found:
    waiting = info.job_counts.get("queued", 0)
    if info.workers:
        return Found("workers", "good", f"{info.workers} alive; {waiting} of your jobs wait")
    hint = "Start workers, and look at their logs; with an autoscaler there are none while nothing waits."
    return Found(
        "workers", "broken" if waiting else "missing", f"none is alive; {waiting} of your jobs wait", hint
    )


def _room(info: Info) -> Found:
    share = info.share
    if not share.max_stored_bytes:
        return Found("room", "good", f"no limit; {share.stored_bytes / 2**30:.1f} GiB are stored")
    left = share.max_stored_bytes - share.stored_bytes
    detail = f"{left / 2**30:.1f} of {share.max_stored_bytes / 2**30:.1f} GiB are left"
    if left > 0:
        return Found("room", "good", detail)
    return Found(
        "room", "broken", detail, "Delete jobs and datasets, or raise the limit: biresnerf tenants set."
    )


def _upload(client: Client) -> Found:
    """Send pictures the whole way: uploaded, stored, read by the check, and deleted."""
    began = time.monotonic()
    with tempfile.TemporaryDirectory() as folder:
        files = list(_pictures(Path(folder)))
        dataset = client.create_dataset("biresnerf doctor", [file.entry for file in files])
        try:
            client.send_missing(dataset, files)
            client.finalize(dataset.id)
        except ServiceError:
            with contextlib.suppress(ServiceError):
                client.delete_dataset(dataset.id)
            raise
    client.delete_dataset(dataset.id)
    took_s = time.monotonic() - began
    return Found("upload", "good", f"{PICTURES} pictures sent, checked and deleted in {took_s:.1f} s")


def _pictures(folder: Path) -> Iterator[LocalFile]:
    for number in range(PICTURES):
        path = folder / f"{number}.png"
        Image.effect_noise((64, 48), 80.0).convert("RGB").save(path)
        yield LocalFile.at(path.name, path)


def _is_loopback(host: str) -> bool:
    try:
        return ipaddress.ip_address(host).is_loopback
    except ValueError:
        return host == "localhost"
