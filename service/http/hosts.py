"""Whose a host name or address is: this machine's alone, or one that others control."""

from __future__ import annotations

import ipaddress


def on_loopback(host: str) -> bool:
    """Whether the address or name is this machine's alone."""
    if host == "localhost":
        return True
    try:
        return ipaddress.ip_address(host.strip("[]")).is_loopback
    except ValueError:
        return False


def is_public_name(host: str) -> bool:
    """Whether others control what the name resolves to: it has a dot and is no loopback address."""
    return "." in host.rstrip(".") and not on_loopback(host)
