"""Which network addresses the service may connect to on behalf of its users: public ones, and those allowed."""

from __future__ import annotations

import ipaddress
from collections.abc import Sequence

Address = ipaddress.IPv4Address | ipaddress.IPv6Address
Network = ipaddress.IPv4Network | ipaddress.IPv6Network

# From IANA's special-purpose registries: `ipaddress.is_global` differs between Python versions, and includes
# multicast and one cloud's metadata service.
_NOT_PUBLIC_4 = tuple(
    map(
        ipaddress.IPv4Network,
        (
            *("0.0.0.0/8", "10.0.0.0/8", "100.64.0.0/10", "127.0.0.0/8", "169.254.0.0/16", "172.16.0.0/12"),
            *("192.0.0.0/24", "192.0.2.0/24", "192.31.196.0/24", "192.52.193.0/24", "192.88.99.0/24"),
            *("192.168.0.0/16", "192.175.48.0/24", "198.18.0.0/15", "198.51.100.0/24", "203.0.113.0/24"),
            *("224.0.0.0/4", "240.0.0.0/4"),
            "168.63.129.16/32",  # Azure's host: a public number that answers every virtual machine
        ),
    )
)
# Of IPv6 only global unicast (2000::/3), without its special ranges: protocol assignments with Teredo
# (2001::/23), documentation, 6to4.
_PUBLIC_6 = ipaddress.IPv6Network("2000::/3")
_NOT_PUBLIC_6 = tuple(
    map(
        ipaddress.IPv6Network,
        ("2001::/23", "2001:db8::/32", "2002::/16", "2620:4f:8000::/48", "3fff::/20"),
    )
)
# IPv4 addresses written as IPv6 (mapped, NAT64): the embedded IPv4 address is checked.
_WRAPPERS = (ipaddress.IPv6Network("::ffff:0:0/96"), ipaddress.IPv6Network("64:ff9b::/96"))
# Interface ids under which ISATAP embeds an IPv4 address.
_ISATAP = (0x0000_5EFE, 0x0200_5EFE)


def may_connect(address: Address, allowed: Sequence[Network] = ()) -> bool:
    """Whether ``address`` is public, or in one of the ``allowed`` networks of a private installation."""
    inner = unwrapped(address)
    if any(inner.version == network.version and inner in network for network in allowed):
        return True
    if isinstance(inner, ipaddress.IPv4Address):
        return not any(inner in network for network in _NOT_PUBLIC_4)
    if inner not in _PUBLIC_6 or (int(inner) >> 32) & 0xFFFF_FFFF in _ISATAP:
        return False
    return not any(inner in network for network in _NOT_PUBLIC_6)


def unwrapped(address: Address) -> Address:
    """The IPv4 address inside a mapped or NAT64 one; any other address unchanged."""
    if isinstance(address, ipaddress.IPv6Address) and any(address in wrapper for wrapper in _WRAPPERS):
        return ipaddress.IPv4Address(int(address) & 0xFFFF_FFFF)
    return address


def parsed(text: str) -> Address:
    """Parses an address in the system resolver's notation; raises `ValueError`."""
    return ipaddress.ip_address(text.partition("%")[0])
