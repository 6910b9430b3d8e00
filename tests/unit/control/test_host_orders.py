"""Orders about hosts: an answer says what is done."""

import asyncio
from collections.abc import Awaitable, Callable

import pytest

from appliance.channel import admin
from appliance.channel.answers.hosts import Reloaded, Revoked
from appliance.control.host_orders import HostOrders
from appliance.hosts.hosts import Hosts


class Told(Hosts):
    """Hosts that are let out as soon as somebody says so."""

    def __init__(self) -> None:
        """There is nothing to keep."""

    async def revoke(self, name: str, who: str, expected: int | None = None) -> Revoked:
        """It had one registration."""
        return Revoked(1, name, "10.113.11.2", "ab", 1)

    async def reload(self, who: str, expected: int | None = None) -> Reloaded:
        """Nothing changes."""
        return Reloaded(1, [], [], [], [])


@pytest.mark.parametrize(
    "order",
    [
        lambda orders: orders.revoke(admin.HostRevoke("ocu-1"), "alice"),
        lambda orders: orders.reload(admin.HostsReload(), "alice"),
    ],
    ids=["revoke", "reload"],
)
def test_who_is_told_that_a_host_is_out_finds_its_connections_closed(
    order: Callable[[HostOrders], Awaitable[object]],
) -> None:
    """The answer waits for the relays."""

    async def check() -> None:
        relays = asyncio.Event()

        async def carried_out() -> None:
            await relays.wait()

        asked = asyncio.ensure_future(order(HostOrders(Told(), carried_out)))
        for _ in range(10):
            await asyncio.sleep(0)
        assert not asked.done()
        relays.set()
        await asked

    asyncio.run(check())
