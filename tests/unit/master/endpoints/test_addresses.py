import asyncio
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


def test_a_host_learns_the_machines_new_address() -> None:
    routes = ["192.168.1.7", "192.168.1.9"]

    async def route(_host: str) -> str | None:
        return routes.pop(0)

    addresses, host = AdvertisedAddresses([], route, "0.0.0.0"), peer("10.0.0.5", "10.0.0.1")
    for _time in range(2):
        autojump.run(addresses.learn(host))
        assert addresses.address_for(host) == "192.168.1.7"
    addresses.forget_routes()
    autojump.run(addresses.learn(host))
    assert addresses.address_for(host) == "192.168.1.9"


@pytest.mark.parametrize(
    ("answers", "told"),
    [
        (["192.168.1.7", "192.168.1.9"], "192.168.1.7"),
        ([None, "192.168.1.9"], "192.168.1.9"),
        ([TimeoutError(), "192.168.1.9"], "192.168.1.9"),
    ],
)
def test_a_host_without_an_address_is_looked_up_again(
    answers: list[str | TimeoutError | None], told: str
) -> None:
    async def route(_host: str) -> str | None:
        answer = answers.pop(0)
        if isinstance(answer, TimeoutError):
            raise answer
        return answer

    addresses, host = AdvertisedAddresses([], route, "0.0.0.0"), peer("10.0.0.5", "10.0.0.1")

    async def calls() -> None:
        await addresses.learn(host)
        await asyncio.sleep(31.0)
        await addresses.learn(host)

    autojump.run(calls())
    assert addresses.address_for(host) == told


def test_a_host_without_an_answer_waits_once_in_a_while() -> None:
    asked: list[str] = []

    async def never(host: str) -> str | None:
        asked.append(host)
        await asyncio.Event().wait()
        return None

    addresses, host = AdvertisedAddresses([], never, "0.0.0.0"), peer("10.0.0.5", "10.0.0.1")

    async def calls() -> None:
        for _call in range(20):
            await addresses.learn(host)
        await asyncio.sleep(60.0)
        await addresses.learn(host)

    autojump.run(calls())
    assert len(asked) == 2


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
