"""No user's address leads the service into internal networks; requests go to the address that was checked."""

from __future__ import annotations

import asyncio
import ipaddress
import socket
import ssl
from collections.abc import AsyncIterator, Sequence
from contextlib import asynccontextmanager
from dataclasses import dataclass, field

import httpcore
import pytest
import trustme

from biresnerf.errors import InputError
from workers.settings.addresses import may_connect
from workers.webhooks.outbound import Outbound, Policy, Refused, checked_url

LOOPBACK = (ipaddress.ip_network("127.0.0.0/8"), ipaddress.ip_network("::1/128"))
INSIDE = """
    0.0.0.0 0.1.2.3 10.0.0.1 10.255.255.255 100.64.0.1 100.100.100.200 100.127.255.254 127.0.0.1 127.255.0.1
    168.63.129.16 169.254.0.1 169.254.169.254 169.254.170.2 172.16.0.1 172.31.255.255 192.0.0.8 192.0.0.192
    192.0.2.1 192.88.99.1 192.168.0.1 192.168.255.255 198.18.0.1 198.19.255.255 198.51.100.7 203.0.113.9
    224.0.0.1 239.255.255.255 240.0.0.1 255.255.255.255
    :: ::1 ::127.0.0.1 ::10.0.0.1 ::8.8.8.8 ::ffff:127.0.0.1 ::ffff:10.1.2.3 ::ffff:169.254.169.254
    ::ffff:0:127.0.0.1 64:ff9b::127.0.0.1 64:ff9b::a9fe:a9fe 64:ff9b::10.0.0.1 64:ff9b:1::1 64:ff9b:1::808:808
    100::1 2001::1 2001:0:4136:e378:8000:63bf:3fff:fdd2 2001:2::1 2001:10::1 2001:20::1 2001:db8::1
    2002:7f00:1::1 2002:a9fe:a9fe:: 2002:808:808::1 2620:4f:8000::1 3fff::1 5f00::1 fc00::1 fd00:ec2::254
    fd12:3456::1 fe80::1 fec0::1 ff02::1 ff0e::1 2600:1f00::5efe:10.0.0.1 2600:1f00::200:5efe:10.0.0.1
"""
OUTSIDE = """
    1.1.1.1 8.8.8.8 9.255.255.255 11.0.0.0 100.63.255.255 100.128.0.0 126.255.255.255 128.0.0.1 168.63.129.15
    169.253.255.255 172.15.255.255 172.32.0.0 192.167.255.255 192.169.0.0 198.17.255.255 198.20.0.0
    223.255.255.255 2001:4860:4860::8888 2606:4700::1111 2a00:1450::1 ::ffff:8.8.8.8 64:ff9b::8.8.8.8
"""
BAD_URLS = """
    http://hooks.example/ ftp://hooks.example/ file:///etc/passwd gopher://hooks.example/ //hooks.example/
    hooks.example https:// https:///path https://user@hooks.example/ https://user:word@hooks.example/
    https://hooks.example/#part https://hooks.example:22/ https://hooks.example:0/ https://hooks.example:99999/
    https://hooks.example:8443/ https://127.0.0.1/ https://127.1/ https://2130706433/ https://0x7f000001/
    https://0177.0.0.1/ https://0x7f.0.0.1/ https://127.0.0.1./ https://0/ https://1.2.3/ https://[::1]/
    https://[::]/ https://[::ffff:127.0.0.1]/ https://[::ffff:a9fe:a9fe]/ https://[64:ff9b::7f00:1]/
    https://[2002:7f00:1::]/ https://[fe80::1%25eth0]/ https://[fd00:ec2::254]/ https://169.254.169.254/latest
    https://localhost/ https://LOCALHOST/ https://localhost./ https://a.localhost/ https://printer.local/
    https://metadata.google.internal/ https://a..b/ https://h\\@127.0.0.1/ https://h%00.example/
    https://１２７.0.0.1/ https://ⓛocalhost/ https://[::1/ https://hooks.example:x/ https:hooks.example
    https://-bad-.exa_mple-/ https://hooks.example,evil.example/
"""


@pytest.mark.parametrize("text", INSIDE.split())
def test_an_address_that_is_not_public_is_refused(text: str):
    assert not may_connect(ipaddress.ip_address(text))


@pytest.mark.parametrize("text", OUTSIDE.split())
def test_a_public_address_next_to_one_that_is_not_is_taken(text: str):
    assert may_connect(ipaddress.ip_address(text))


def test_an_allowed_network_is_allowed_in_every_spelling_and_nothing_else_is():
    allowed = (ipaddress.ip_network("10.1.0.0/16"), ipaddress.ip_network("fd12::/16"))
    for text in ("10.1.2.3", "::ffff:10.1.2.3", "64:ff9b::10.1.2.3", "fd12::7"):
        assert may_connect(ipaddress.ip_address(text), allowed)
    for text in ("10.2.0.1", "::ffff:10.2.0.1", "fd13::7", "127.0.0.1"):
        assert not may_connect(ipaddress.ip_address(text), allowed)


@pytest.mark.parametrize("url", [*BAD_URLS.split(), "https://a b/", "https://a\tb/", "https://a.example/\n"])
def test_a_url_that_could_lead_elsewhere_is_refused(url: str):
    with pytest.raises(InputError) as told:
        checked_url(url, Policy())
    assert told.value.code == "webhook_url_refused"


@pytest.mark.parametrize(
    "url",
    [
        "https://hooks.example/in?a=b",
        "https://hooks.example:443",
        "https://bücher.example/",
        "https://8.8.8.8/",
        "https://[2606:4700::1111]/",
        "https://3com.example/",
    ],
)
def test_an_ordinary_https_url_is_taken(url: str):
    assert checked_url(url, Policy())


@dataclass
class Receiver:
    """A real server that keeps what it hears."""

    answer: bytes = b"HTTP/1.1 204 No Content\r\n\r\n"
    heard: list[bytes] = field(default_factory=list)
    names: list[str | None] = field(default_factory=list)
    port: int = 0

    async def hear(self, reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        try:
            head = await reader.readuntil(b"\r\n\r\n")
            size = int(head.lower().split(b"content-length:")[1].split(b"\r\n")[0])
            self.heard.append(head + await reader.readexactly(size))
            writer.write(self.answer)
            await writer.drain()
        except (ConnectionError, asyncio.IncompleteReadError):
            pass
        finally:
            writer.close()


@asynccontextmanager
async def receiving(receiver: Receiver, tls: ssl.SSLContext | None = None) -> AsyncIterator[Receiver]:
    if tls is not None:
        tls.sni_callback = lambda _, name, __: receiver.names.append(name)
    server = await asyncio.start_server(receiver.hear, "127.0.0.1", 0, ssl=tls)
    receiver.port = server.sockets[0].getsockname()[1]
    try:
        yield receiver
    finally:
        server.close()


class Names:
    """A name server of the test's own: the answers in turn, the last one for ever."""

    def __init__(self, *answers: Sequence[str]) -> None:
        self.answers, self.asked = list(answers), 0

    async def __call__(self, host: str, port: int) -> Sequence[str]:
        self.asked += 1
        if not self.answers[0]:
            raise socket.gaierror(socket.EAI_NONAME, "no such name")
        return self.answers.pop(0) if len(self.answers) > 1 else self.answers[0]


def open_policy(port: int, *, plain_http: bool = True) -> Policy:
    return Policy(plain_http=plain_http, ports=(port,), networks=LOOPBACK)


@pytest.mark.anyio
async def test_tls_and_host_keep_the_name_while_the_connection_goes_to_the_judged_address():
    authority = trustme.CA()
    server, client = ssl.SSLContext(ssl.PROTOCOL_TLS_SERVER), ssl.create_default_context()
    authority.issue_cert("hooks.example").configure_cert(server)
    authority.configure_trust(client)
    async with receiving(Receiver(), server) as receiver:
        policy, names = open_policy(receiver.port, plain_http=False), Names(["127.0.0.1"])
        outbound = Outbound(policy, resolve=names, tls=client)
        url = f"https://hooks.example:{receiver.port}/in?x=1"
        answer = await outbound.send(
            "POST", url, b'{"a":1}', {"Content-Type": "application/json"}, size=7, timeout_s=5
        )
        assert (answer.status, names.asked) == (204, 1)
        assert receiver.names == ["hooks.example"]
        (heard,) = receiver.heard
        assert heard.startswith(b"POST /in?x=1 HTTP/1.1\r\n")
        assert f"\r\nHost: hooks.example:{receiver.port}\r\n".encode() in heard
        assert heard.endswith(b'\r\n\r\n{"a":1}')
        # A certificate of another name is refused, as the name is what counts.
        with pytest.raises(httpcore.ConnectError):
            await outbound.send(
                "POST", f"https://other.example:{receiver.port}/", b"", {}, size=0, timeout_s=5
            )
        assert len(receiver.heard) == 1


@pytest.mark.anyio
@pytest.mark.parametrize(
    "inside", ["127.0.0.1", "::1", "::ffff:127.0.0.1", "169.254.169.254", "fe80::1%eth0"]
)
async def test_a_name_that_leads_inside_is_not_connected_to(inside: str):
    async with receiving(Receiver()) as receiver:
        policy = Policy(plain_http=True, ports=(receiver.port,))
        for answer in ([inside], ["8.8.8.8", inside]):
            with pytest.raises(Refused) as told:
                await Outbound(policy, resolve=Names(answer)).send(
                    "POST", f"http://hooks.example:{receiver.port}/", b"", {}, size=0, timeout_s=5
                )
            assert told.value.code == "address_refused"
        assert receiver.heard == []


@pytest.mark.anyio
async def test_a_name_that_changes_its_mind_is_judged_by_the_address_that_is_used():
    async with receiving(Receiver()) as receiver:
        policy = open_policy(receiver.port)
        names = Names(["127.0.0.1"], ["192.168.7.7"])
        outbound, url = Outbound(policy, resolve=names), f"http://hooks.example:{receiver.port}/"
        assert (await outbound.send("POST", url, b"", {}, size=0, timeout_s=5)).status == 204
        assert names.asked == 1, "resolved once: no second answer can slip in between check and connection"
        with pytest.raises(Refused):
            await outbound.send("POST", url, b"", {}, size=0, timeout_s=5)
        assert names.asked == 2


@pytest.mark.anyio
async def test_the_systems_resolver_is_judged_too():
    async with receiving(Receiver()) as receiver:
        strict = Outbound(Policy(plain_http=True, ports=(receiver.port,), networks=LOOPBACK[1:]))
        with pytest.raises(Refused):
            await strict.send("POST", f"http://localhost:{receiver.port}/", b"", {}, size=0, timeout_s=5)
        lenient = Outbound(open_policy(receiver.port))
        assert (
            await lenient.send("POST", f"http://localhost:{receiver.port}/", b"", {}, size=0, timeout_s=5)
        ).status == 204
        with pytest.raises(Refused) as told:
            await Outbound(open_policy(1), resolve=Names([])).send(
                "POST", "http://a.example:1/", b"", {}, size=0, timeout_s=5
            )
        assert told.value.code == "name_not_found"


@pytest.mark.anyio
async def test_a_redirect_is_an_answer_and_is_not_followed():
    async with receiving(Receiver()) as inside:
        to = f"HTTP/1.1 307 T\r\nLocation: http://127.0.0.1:{inside.port}/\r\nContent-Length: 0\r\n\r\n"
        async with receiving(Receiver(to.encode())) as receiver:
            outbound = Outbound(Policy(True, (receiver.port, inside.port), LOOPBACK))
            answer = await outbound.send(
                "POST", f"http://127.0.0.1:{receiver.port}/", b"x", {}, size=1, timeout_s=5
            )
            assert answer.status == 307
            assert len(receiver.heard) == 1
        assert inside.heard == []


@pytest.mark.anyio
@pytest.mark.parametrize(
    "answer",
    [
        pytest.param(b"HTTP/1.1 100 Continue\r\n\r\n" * 3, id="never more than interim answers"),
        pytest.param(b"", id="nothing"),
        pytest.param(b"HTTP/1.1 200 OK\r\nX: " + b"y" * 2_000_000, id="headers without end"),
        pytest.param(b"\x00\xff not HTTP at all\r\n\r\n", id="no HTTP"),
    ],
)
async def test_an_answer_that_is_none_fails_and_is_not_kept(answer: bytes):
    async with receiving(Receiver(answer)) as receiver:
        with pytest.raises((httpcore.ProtocolError, httpcore.NetworkError, TimeoutError)):
            await Outbound(open_policy(receiver.port)).send(
                "POST", f"http://127.0.0.1:{receiver.port}/", b"", {}, size=0, timeout_s=3
            )


@pytest.mark.anyio
async def test_the_time_limit_covers_everything_and_a_long_body_is_not_read():
    class Slow(Receiver):
        async def hear(self, reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
            try:
                while True:
                    writer.write(b"HTTP/1.1 102 Processing\r\n\r\n")
                    await writer.drain()
                    await asyncio.sleep(0.02)
            except ConnectionError:
                writer.close()

    async with receiving(Slow()) as receiver:
        with pytest.raises(TimeoutError):
            await Outbound(open_policy(receiver.port)).send(
                "POST", f"http://127.0.0.1:{receiver.port}/", b"", {}, size=0, timeout_s=0.3
            )
    endless = Receiver(
        b"HTTP/1.1 200 OK\r\nRetry-After: 7\r\nContent-Length: 9000000000\r\n\r\n" + b"x" * 100_000
    )
    async with receiving(endless) as receiver:
        answer = await Outbound(open_policy(receiver.port)).send(
            "POST", f"http://127.0.0.1:{receiver.port}/", b"", {}, size=0, timeout_s=5
        )
        assert (answer.status, answer.headers["retry-after"]) == (200, "7")


async def got(outbound: Outbound, url: str, *, head_s: float = 5.0, idle_s: float = 5.0) -> bytes:
    headers = {"Accept-Encoding": "identity", "content-length": "0"}  # by which the receiver knows the end
    async with outbound.get(url, headers, head_s=head_s, idle_s=idle_s) as (answer, chunks):
        return b"%d " % answer.status + b"".join([chunk async for chunk in chunks])


@pytest.mark.anyio
async def test_each_redirect_of_a_get_is_judged_like_the_first_address():
    content = b"HTTP/1.1 200 OK\r\nContent-Length: 3\r\n\r\nabc"
    async with receiving(Receiver(content)) as receiver:
        port = receiver.port
        outbound = Outbound(open_policy(port), resolve=Names(["127.0.0.1"]))
        assert await got(outbound, f"http://files.example:{port}/a") == b"200 abc"
        for to, code in [
            (f"http://inner.example:{port}/", "address_refused"),  # a name of an address inside
            ("http://169.254.169.254/", "url_refused"),
            ("http://10.0.0.1/", "url_refused"),
            (f"gopher://files.example:{port}/", "url_refused"),
            ("http://[::1/", "url_refused"),
        ]:
            receiver.heard.clear()
            receiver.answer = f"HTTP/1.1 302 F\r\nLocation: {to}\r\nContent-Length: 0\r\n\r\n".encode()
            outbound = Outbound(open_policy(port), resolve=Names(["127.0.0.1"], ["169.254.169.254"]))
            with pytest.raises(Refused) as told:
                await got(outbound, f"http://files.example:{port}/a")
            assert (told.value.code, len(receiver.heard)) == (code, 1)


@pytest.mark.anyio
async def test_a_get_that_stops_in_its_head_or_body_ends_in_time():
    head = b"HTTP/1.1 200 OK\r\nContent-Length: 9\r\n\r\n"

    class Stops(Receiver):
        async def hear(self, reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
            await reader.readuntil(b"\r\n\r\n")
            writer.write(self.answer)
            await writer.drain()
            await asyncio.sleep(3)
            writer.close()

    for answer in (head[:9], head + b"abc"):
        async with receiving(Stops(answer)) as receiver:
            with pytest.raises(TimeoutError):
                await got(
                    Outbound(open_policy(receiver.port)),
                    f"http://127.0.0.1:{receiver.port}/",
                    head_s=0.3,
                    idle_s=0.3,
                )
