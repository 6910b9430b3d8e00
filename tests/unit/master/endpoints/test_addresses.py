"""Which of the appliance's addresses a peer is told."""

import asyncio
import ipaddress

import pytest

from appliance.master.endpoints.endpoint_addresses import Addresses
from appliance.rpc.server import Peer


def peer(host: str, local: str) -> Peer:
    """Somebody who reached the appliance at `local`."""
    return Peer(ipaddress.ip_address(host), host, local)


@pytest.mark.parametrize(
    ("listen", "local", "told"),
    [
        ("0.0.0.0", "10.0.0.1", "10.0.0.1"),
        ("0.0.0.0", "127.0.0.1", "127.0.0.1"),
        ("::", "fd00::1", "fd00::1"),
        ("10.0.0.1", "10.0.0.1", "10.0.0.1"),
        ("10.0.0.1", "127.0.0.1", "10.0.0.1"),
        ("127.0.0.1", "127.0.0.1", "127.0.0.1"),
    ],
)
def test_what_is_told_is_listened_on(listen: str, local: str, told: str) -> None:
    """The address he came to; the appliance's own nodes come on loopback, where faces and relay may not listen."""
    assert Addresses([], None, listen).told_to(peer("127.0.0.1", local)) == told


def test_what_is_configured_or_translated_comes_first() -> None:
    """`advertise` for a network, then the address that the supervisor knows for this peer."""

    async def route(host: str) -> str | None:
        return "192.168.1.7" if host == "10.0.0.5" else None

    advertised = [(ipaddress.ip_network("172.16.0.0/12"), ipaddress.ip_address("172.16.0.9"))]
    addresses = Addresses(advertised, route, "0.0.0.0")
    for host in ("10.0.0.5", "10.0.0.6", "172.16.0.1"):
        asyncio.run(addresses.learn(peer(host, "10.0.0.1")))
    assert addresses.told_to(peer("10.0.0.5", "10.0.0.1")) == "192.168.1.7"
    assert addresses.told_to(peer("10.0.0.6", "10.0.0.1")) == "10.0.0.1"
    assert addresses.told_to(peer("172.16.0.1", "10.0.0.1")) == "172.16.0.9"
