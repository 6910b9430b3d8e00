"""Decide which pages may open a WebSocket, by the Origin that a browser sends.

Programs send no Origin, or the address they connect to. An attacker's name may resolve to any address (DNS
rebinding), so an Origin that equals the Host is accepted only for an address or `localhost`.
"""

import ipaddress
from collections.abc import Collection, Sequence
from urllib.parse import urlsplit

from websockets.datastructures import Headers


def rejection(headers: Headers, listed: Collection[str]) -> str:
    origins, hosts = headers.get_all("Origin"), headers.get_all("Host")
    if not origins or (len(origins) == 1 and origins[0] in listed) or _is_own(origins, hosts):
        return ""
    return f"pages of the origin {origins[0][:200]!a} may not connect to this door; list the origin to allow them"


def _is_own(origins: Sequence[str], hosts: Sequence[str]) -> bool:
    if (
        len(origins) != 1
        or len(hosts) != 1
        or origins[0] not in (f"http://{hosts[0]}", f"https://{hosts[0]}")
    ):
        return False
    try:
        name = urlsplit(f"//{hosts[0]}").hostname or ""
        return name == "localhost" or ipaddress.ip_address(name) is not None
    except ValueError:
        return False
