"""Requests made from the OpenAPI document, with one or a few hostile values each, sent as bytes over many connections.

Sends some hundred a second; schemathesis sends a few, but checks each answer closely. This looks for server errors and
for information that an answer must not reveal.
"""

from __future__ import annotations

import asyncio
import contextlib
import json
import random
import time
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any
from urllib.parse import quote

from tests.service.hostile_values import HEADERS, NUMBERS, OTHERS, RAW, TEXTS
from tests.service.http.test_strict_http import MALFORMED

ANSWER_S = 30.0
SHOWN = 20
FORM = b'--b\r\nContent-Disposition: form-data; name="%s"%s\r\n\r\n%s\r\n--b--\r\n'


# What may start a process is sent less often: nearly all of the time would go there.
PROCESSES = {("POST", name) for name in ("archive", "finalize", "jobs", "fork", "exports")}


@dataclass
class Seen:
    """What was sent and answered."""

    sent: int = 0
    statuses: Counter[int] = field(default_factory=Counter)
    operations: Counter[str] = field(default_factory=Counter)
    broken: list[str] = field(default_factory=list)


class Generator:
    """Requests as bytes. ``known`` has values for path parameters that exist."""

    def __init__(
        self,
        document: Mapping[str, Any],
        known: Mapping[str, Sequence[str]],
        access: str,
        chance: random.Random,
    ) -> None:
        self._schemas, self._known = document["components"]["schemas"], known
        self._access, self._chance = access, chance
        self._operations = [
            (method.upper(), path, operation)
            for path, methods in document["paths"].items()
            for method, operation in methods.items()
            if method in ("get", "head", "post", "put", "patch", "delete", "options")
        ]

    def request(self) -> tuple[str, str, bytes]:
        """Its operation, its method and its bytes."""
        if self._chance.random() < 0.02:
            name = self._chance.choice(sorted(MALFORMED))
            return name, "GET", MALFORMED[name]
        method, path, operation = self._chance.choice(self._operations)
        if (method, path.rsplit("/", 1)[1]) in PROCESSES and self._chance.random() < 0.8:
            method, path, operation = self._chance.choice(self._operations)
        target, headers = self._target(method, path, operation)
        body = self._body(operation, headers)
        if self._chance.random() < 0.03:
            method = self._chance.choice(("TRACE", "PROPFIND", "PUT", "DELETE", "get"))
        for name in self._chance.sample(sorted(HEADERS), self._chance.choice((0, 0, 0, 1, 1, 3))):
            headers[name] = self._chance.choice(HEADERS[name])
        if body or method in ("POST", "PUT", "PATCH"):
            headers["Content-Length"] = str(len(body))
        head = f"{method} {target} HTTP/1.1\r\n" + "".join(f"{k}: {v}\r\n" for k, v in headers.items())
        return f"{method} {path}", method, head.encode("utf-8", "surrogatepass") + b"\r\n" + body

    def _target(self, method: str, path: str, operation: Mapping[str, Any]) -> tuple[str, dict[str, str]]:
        query, headers = [], {"Host": "127.0.0.1", "Authorization": self._access}
        for parameter in operation.get("parameters", ()):
            name, place = parameter["name"], parameter["in"]
            if place == "path":
                # What deletes gets ids that exist nowhere, or those of other kinds.
                real = self._known.get(name, ()) if method != "DELETE" else ()
                text = self._chance.choice(real) if real and self._chance.random() < 0.7 else self._text()
                path = path.replace("{" + name + "}", _quoted(text))
            elif place == "query" and self._chance.random() < 0.5:
                # A value that fits would let the answer wait.
                text = self._text() if name == "wait" else str(self._value(parameter.get("schema", {})))
                query.append(f"{name}={_quoted(text)}")
            elif place == "header" and name != "authorization" and self._chance.random() < 0.3:
                headers[name] = _quoted(self._text()[:2000])
        return path + ("?" + "&".join(query) if query else ""), headers

    def _text(self) -> str:
        if self._chance.random() < 0.2:
            return "".join(
                chr(self._chance.randrange(1, 0x250)) for _ in range(self._chance.randrange(1, 30))
            )
        return self._chance.choice(TEXTS)

    def _body(self, operation: Mapping[str, Any], headers: dict[str, str]) -> bytes:
        contents = operation.get("requestBody", {}).get("content", {})
        if not contents:
            return self._chance.randbytes(8) if self._chance.random() < 0.05 else b""
        kind = self._chance.choice(sorted(contents))
        headers["Content-Type"] = kind
        if kind == "application/json":
            return self._json(contents[kind].get("schema", {}))
        if kind.startswith("multipart/"):
            headers["Content-Type"] = "multipart/form-data; boundary=b"
            name = self._chance.choice((b"options", b"archive", b"labels", b"priority", b"x", b'a"b'))
            named = self._chance.choice((b"", b'; filename="a.zip"', b"; filename*=UTF-8''%00"))
            return FORM % (name, named, self._json({"type": "object"}))
        return self._chance.choice((b"", b"x", b"PK\x03\x04", self._chance.randbytes(40)))

    def _json(self, schema: Mapping[str, Any]) -> bytes:
        value = self._value(schema, hostile=self._chance.choice((0.0, 0.05, 0.05, 0.3)))
        text = json.dumps(value)
        if self._chance.random() < 0.1:
            at = self._chance.randrange(len(text))
            text = text[:at] + self._chance.choice(RAW) + text[at + self._chance.randrange(3) :]
        return text.encode()

    def _value(self, schema: Mapping[str, Any], depth: int = 0, hostile: float = 0.5) -> Any:
        chance = self._chance
        if chance.random() < hostile:
            return chance.choice((self._text(), chance.choice(NUMBERS), chance.choice(OTHERS)))
        if "$ref" in schema:
            return self._value(self._schemas[schema["$ref"].rsplit("/", 1)[-1]], depth, hostile)
        for several in ("anyOf", "oneOf", "allOf"):
            if several in schema:
                return self._value(chance.choice(schema[several]), depth, hostile)
        if "const" in schema:
            return schema["const"]
        if "enum" in schema:
            return chance.choice(schema["enum"])
        if schema.get("examples") and chance.random() < 0.3:
            return chance.choice(schema["examples"])
        kind = schema.get("type")
        if kind == "object" and depth < 6:
            fields, needed = schema.get("properties", {}), schema.get("required", ())
            few = min(1.0, 4 / max(1, len(fields)))
            found = {
                name: self._value(one, depth + 1, hostile)
                for name, one in fields.items()
                if name in needed or chance.random() < few
            }
            return found | ({self._text(): self._text()} if chance.random() < hostile else {})
        if kind == "array" and depth < 6:
            return [
                self._value(schema.get("items", {}), depth + 1, hostile) for _ in range(chance.randrange(3))
            ]
        low, high = schema.get("minimum", 0), schema.get("maximum", 1000)
        if kind == "integer":
            return chance.choice((low, high, chance.randint(int(low), int(high))))
        if kind == "number":
            return chance.choice((low, high, chance.uniform(low, high)))
        return chance.choice((True, False)) if kind == "boolean" else self._text()


def _quoted(text: str) -> str:
    return quote(text.encode("utf-8", "surrogatepass"), safe="")


async def send_all(
    port: int, generator: Generator, secrets: Sequence[str], *, requests: int, seconds: float, width: int = 8
) -> Seen:
    """Sends until so many were answered or the time is over. ``secrets`` may stand in no answer."""
    seen, end = Seen(), time.monotonic() + seconds

    async def one_connection() -> None:
        streams: tuple[asyncio.StreamReader, asyncio.StreamWriter] | None = None
        while seen.sent < requests and time.monotonic() < end:
            name, method, sent = generator.request()
            seen.sent += 1
            streams = streams or await asyncio.open_connection("127.0.0.1", port)
            try:
                async with asyncio.timeout(ANSWER_S):
                    status, told, stays = await _answer(*streams, sent, method)
            except (OSError, EOFError, TimeoutError, ValueError) as error:
                status, told, stays = 0, repr(error), False
            seen.statuses[status] += 1
            seen.operations[name] += 1
            leaks = [secret for secret in secrets if secret in told]
            busy = name == "GET /readyz" and status == 503  # it is what it says of a store that answers late
            if (status == 0 or status >= 500 or leaks) and not busy:
                seen.broken.append(f"{name}: {status} {leaks} {told[-300:]!r} for {sent[:600]!r}")
            if not stays:
                streams[1].close()
                with contextlib.suppress(OSError):
                    await streams[1].wait_closed()
                streams = None
        if streams is not None:
            streams[1].close()

    await asyncio.gather(*(one_connection() for _ in range(width)))
    return seen


async def _answer(
    reader: asyncio.StreamReader, writer: asyncio.StreamWriter, sent: bytes, method: str
) -> tuple[int, str, bool]:
    """Status, text, and whether the connection can be used again: not while a stream may follow."""
    writer.write(sent)
    head = (await reader.readuntil(b"\r\n\r\n")).decode("latin-1")
    while head.startswith("HTTP/1.1 100"):
        head = (await reader.readuntil(b"\r\n\r\n")).decode("latin-1")
    status = int(head.split(" ", 2)[1])
    fields = dict(line.lower().split(": ", 1) for line in head.split("\r\n")[1:] if line)
    if method == "HEAD" or status in (204, 304):
        return status, head, fields.get("connection") != "close"
    if "content-length" not in fields:
        return status, head, False
    body = await reader.readexactly(int(fields["content-length"]))
    return status, head + body.decode("latin-1"), fields.get("connection") != "close"
