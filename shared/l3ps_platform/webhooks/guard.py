"""Where a webhook may go: whoever names a URL must not make the service call into its own network.

Each delivery resolves the name once, looks at every address found, and connects to one of those that were looked at: a
name that means another address a moment later (DNS rebinding) changes nothing. Redirects are never followed.

Ports: 80, 443 and all from 1024. Below 1024 live mail, shells and name servers, which a POST could disturb and which
no receiver uses; above, receivers are everywhere (3000, 8080, 8443 …), and that addresses are public protects what else
is there. An address that the settings allow may be reached on any port.
"""

from __future__ import annotations

import socket
from collections.abc import Callable, Sequence
from contextlib import suppress
from dataclasses import dataclass
from ipaddress import IPv4Address, IPv4Network, IPv6Address, IPv6Network, ip_address

import httpx

from l3ps_platform.errors import TargetRefused

Address = IPv4Address | IPv6Address
Network = IPv4Network | IPv6Network
Resolver = Callable[[str, int], Sequence[str]]

MAX_URL = 2000
MAX_ADDRESSES = 32
HTTP_PORTS = (80, 443)
FIRST_FREE_PORT = 1024

_GLOBAL_UNICAST = IPv6Network("2000::/3")  # all that is handed out; the rest is private, local or not in use
_NAT64 = IPv6Network("64:ff9b::/96")
# Special purpose by the registry of RFC 6890, but public in the view of some versions of `ipaddress`.
_SPECIAL = tuple(map(IPv4Network, ("192.0.0.0/24", "192.88.99.0/24")))


@dataclass(frozen=True, slots=True)
class Target:
    """A URL whose host was resolved and found admissible.

    Attributes:
        url: as given.
        addresses: all that its host means, in the resolver's order.
    """

    url: httpx.URL
    addresses: tuple[Address, ...]

    def at(self, address: Address) -> httpx.URL:
        """The same URL, to be reached at one of the addresses."""
        return self.url.copy_with(host=str(address))


def resolve(host: str, port: int) -> Sequence[str]:
    """The addresses of a host name, by the system's resolver. OSError."""
    found = socket.getaddrinfo(host, port, type=socket.SOCK_STREAM, proto=socket.IPPROTO_TCP)
    return [str(entry[4][0]) for entry in found]


class Guard:
    """Says which targets are admissible.

    Args:
        allow: networks that may be reached though they are not public.
        http: whether a URL may go without TLS.
        resolver: to find addresses by.
    """

    def __init__(self, allow: Sequence[Network] = (), *, http: bool = False, resolver: Resolver = resolve) -> None:
        self._allow = tuple(allow)
        self._http = http
        self._resolve = resolver

    def admit(self, url: str) -> Target:
        """The target that a URL names. TargetRefused says why there is none.

        In the same words for a name that means nothing, nothing public, or nothing that the resolver tells: whoever
        asks may not learn the names and numbers of the network that the service is in.
        """
        parsed = self._parse(url)
        port = parsed.port or (443 if parsed.scheme == "https" else 80)
        found: list[Address] = []
        with suppress(OSError, ValueError):  # which is as good as none
            found = [_plain(ip_address(text)) for text in self._resolve(host_of(parsed), port)]
        # The same address may come once a protocol; a name with more than a handful has no good reason to.
        addresses = tuple(dict.fromkeys(found))
        foreign = [address for address in addresses if not self._allowed(address)]
        if not 0 < len(addresses) <= MAX_ADDRESSES or not all(map(is_public, foreign)):
            raise TargetRefused(f"{parsed.host!r} is no public address and no name of one", _PUBLIC)
        if foreign and port not in HTTP_PORTS and port < FIRST_FREE_PORT:
            raise TargetRefused(f"port {port} is not one that webhooks are sent to", _PORTS)
        return Target(parsed, addresses)

    def _parse(self, url: str) -> httpx.URL:
        if len(url) > MAX_URL:
            raise TargetRefused(f"the URL has {len(url)} characters", f"Use one of at most {MAX_URL}.")
        try:
            parsed = httpx.URL(url)
            hostless = not parsed.host  # which decodes "xn--…", or fails to
        except (httpx.InvalidURL, ValueError):
            raise TargetRefused("it is not a URL", "Give an absolute URL such as https://example.com/hook.") from None
        if parsed.scheme not in ("https", "http") or hostless:
            raise TargetRefused("it is not a web address", "Give an absolute URL such as https://example.com/hook.")
        if parsed.scheme == "http" and not self._http:
            raise TargetRefused("it is not encrypted", "Use https (L3PS_WEBHOOK_HTTP=1 on the service permits http).")
        if parsed.userinfo:
            raise TargetRefused("it holds credentials", "Remove them: calls are signed with the webhook's secret.")
        if parsed.port is not None and not 0 < parsed.port < 1 << 16:
            raise TargetRefused(f"port {parsed.port} does not exist", _PORTS)
        return parsed.copy_with(fragment=None)

    def _allowed(self, address: Address) -> bool:
        return any(address in network for network in self._allow)


_PUBLIC = (
    "Use a name that is in the public DNS, or a public address (L3PS_WEBHOOK_ALLOW on the service lists the others "
    "that may be called)."
)
_PORTS = f"Use port 443, 80, or one from {FIRST_FREE_PORT}."


def is_public(address: Address) -> bool:
    """Whether an address belongs to the public Internet, whichever way it is written."""
    inner = embedded(address)
    if inner is not None:
        return is_public(inner)
    if isinstance(address, IPv4Address):
        # 240/4 and the broadcast address are "reserved"; multicast counts as global for `ipaddress`.
        special = any(address in network for network in _SPECIAL)
        return address.is_global and not (address.is_multicast or address.is_reserved or special)
    return address in _GLOBAL_UNICAST and address.is_global and address.scope_id is None


def embedded(address: Address) -> IPv4Address | None:
    """The IPv4 address that an IPv6 one leads to: mapped, 6to4, or through NAT64. (Teredo's are not public.)"""
    if isinstance(address, IPv4Address):
        return None
    if address in _NAT64:
        return IPv4Address(int(address) & 0xFFFF_FFFF)
    return address.ipv4_mapped or address.sixtofour


def host_of(url: httpx.URL) -> str:
    """A URL's host as DNS and TLS spell it."""
    return url.raw_host.decode("ascii")


def _plain(address: Address) -> Address:
    # ::ffff:127.0.0.1 is 127.0.0.1, to the kernel too.
    return (address.ipv4_mapped or address) if isinstance(address, IPv6Address) else address
