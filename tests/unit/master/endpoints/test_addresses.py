import ipaddress

import pytest

from appliance.master.endpoints.node_ports import AdvertisedAddresses
from appliance.rpc.server import Peer
from tests.support import autojump


def peer(host: str, local: str) -> Peer:
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
def test_the_appliance_listens_on_the_address_in_answers(listen: str, local: str, told: str) -> None:
    assert AdvertisedAddresses([], None, listen).address_for(peer("127.0.0.1", local)) == told


def test_configured_and_translated_addresses_come_first() -> None:
    async def route(host: str) -> str | None:
        return "192.168.1.7" if host == "10.0.0.5" else None

    advertised = [(ipaddress.ip_network("172.16.0.0/12"), ipaddress.ip_address("172.16.0.9"))]
    addresses = AdvertisedAddresses(advertised, route, "0.0.0.0")
    for host in ("10.0.0.5", "10.0.0.6", "172.16.0.1"):
        autojump.run(addresses.learn(peer(host, "10.0.0.1")))
    assert addresses.address_for(peer("10.0.0.5", "10.0.0.1")) == "192.168.1.7"
    assert addresses.address_for(peer("10.0.0.6", "10.0.0.1")) == "10.0.0.1"
    assert addresses.address_for(peer("172.16.0.1", "10.0.0.1")) == "172.16.0.9"
