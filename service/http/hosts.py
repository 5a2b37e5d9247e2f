"""Classifies host names and addresses: loopback, or controlled by others."""

from __future__ import annotations

import ipaddress
import re

# Labels of host and container names; RFC 1123 forbids the underscore, Compose uses it.
_LABEL = r"[A-Za-z0-9](?:[\w-]{0,61}[A-Za-z0-9])?"
_NAME = re.compile(rf"{_LABEL}(?:\.{_LABEL})*\.?", re.ASCII)
_PLACE = re.compile(r"(\[[^]]*\]|[^:\[\]]*)(?::[0-9]{1,5})?", re.ASCII)


def is_host(text: str) -> bool:
    """Whether a Host header is valid: a name or an IP address, with or without a port."""
    place = _PLACE.fullmatch(text)
    if place is None or len(text) > 260:
        return False
    host = place[1]
    try:
        if host.startswith("["):
            return ipaddress.ip_address(host[1:-1]).version == 6
        if host.rstrip(".").rpartition(".")[2].isdigit():  # no top-level domain is a number
            return ipaddress.ip_address(host).version == 4
    except ValueError:
        return False
    return _NAME.fullmatch(host) is not None


def on_loopback(host: str) -> bool:
    """Whether the address or name is a loopback one."""
    if host == "localhost":
        return True
    try:
        return ipaddress.ip_address(host.strip("[]")).is_loopback
    except ValueError:
        return False


def is_public_name(host: str) -> bool:
    """Whether others control what the name resolves to: it has a dot and is no loopback address."""
    return "." in host.rstrip(".") and not on_loopback(host)
