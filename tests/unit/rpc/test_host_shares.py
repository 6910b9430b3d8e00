"""Members of one hostile host, of each kind, beside those of honest hosts."""

import asyncio
from collections.abc import Awaitable, Callable

import pytest

from appliance.base import clock
from appliance.rpc.host_shares import HostShare, serve_by_host

pytestmark = pytest.mark.anyio
SHARE = HostShare(host=3.0, whole=5.0, host_at_once=4, at_once=128)


async def silent() -> str:
    await asyncio.Event().wait()
    return "never"


async def slow() -> str:
    await asyncio.sleep(2.0)
    return "slow"


async def odd() -> str:
    return "odd"


@pytest.mark.parametrize("behaves", [silent, slow, odd])
@pytest.mark.parametrize("hosts", [1, 100])
async def test_hostile_members_delay_no_honest_one_and_the_whole_has_an_end(
    behaves: Callable[[], Awaitable[str]], hosts: int
) -> None:
    members = {f"hostile{number}": f"10.0.0.{number % hosts}" for number in range(500)}
    members |= {"own": "port 4001", "nuc": "192.168.50.2"}
    at: dict[str, float] = {}

    async def work(name: str) -> str:
        if name.startswith("hostile"):
            return await behaves()
        await asyncio.sleep(0.1)
        at[name] = clock.now()
        return "honest"

    began = clock.now()
    results = await serve_by_host(members, work, SHARE)
    assert (results["own"], results["nuc"]) == ("honest", "honest")
    assert clock.now() - began <= SHARE.whole
    if hosts == 1:
        assert max(at.values()) - began < 0.2, "another host's members wait for nothing"


async def test_the_first_members_are_served_first_and_a_host_has_its_time_from_its_first_turn() -> None:
    share = HostShare(host=1.0, whole=5.0, at_once=1)
    order: list[str] = []

    async def work(name: str) -> str:
        order.append(name)
        await asyncio.sleep(0.9)
        return name

    results = await serve_by_host({"own": "a", "second": "b", "third": "c"}, work, share)
    assert results.keys() == {*order} == {"own", "second", "third"}
    assert order[0] == "own"


async def test_members_that_were_not_served_are_left_out() -> None:
    async def work(_name: int) -> str:
        return await slow()

    assert len(await serve_by_host(dict.fromkeys(range(20), "10.0.0.1"), work, SHARE)) == 4
