"""Ask control which nodes are on the same host, so that a door divides its queries by host.

A door learns no address of another host: control gives each host a number, and the robot's machine the first.
"""

import asyncio
from collections.abc import Callable, Collection, Mapping

from appliance.features.doors.door_link import MAX_NODES, HostsWanted

_SECONDS = 2.0
ROBOT = "0"
"""The robot's own machine, as `NodeHosts.of` names it."""


class NodeHosts:
    """Asks for the hosts of nodes. `ask(message)` sends a request, and returns False without a link."""

    def __init__(self, ask: Callable[[HostsWanted], bool]) -> None:
        self._ask = ask
        self._number = 0
        self._waiting: dict[int, asyncio.Future[list[int]]] = {}

    async def of(self, nodes: Collection[str]) -> Mapping[str, str]:
        """Return what control knows: nodes that are missing count as hosts of their own."""
        names, found = sorted(nodes), dict[str, str]()
        for start in range(0, len(names), MAX_NODES):
            part = names[start : start + MAX_NODES]
            hosts = await self._asked(part)
            found |= {name: str(host) for name, host in zip(part, hosts, strict=False) if host >= 0}
        return found

    async def _asked(self, nodes: list[str]) -> list[int]:
        self._number += 1
        number = self._number
        future = self._waiting[number] = asyncio.get_running_loop().create_future()
        try:
            if not self._ask(HostsWanted(number, nodes)):
                return []
            async with asyncio.timeout(_SECONDS):
                hosts: list[int] = await future
                return hosts
        except TimeoutError:  # control starts again
            return []
        finally:
            del self._waiting[number]

    def given(self, number: int, hosts: list[int]) -> None:
        future = self._waiting.get(number)
        if future is not None and not future.done():
            future.set_result(hosts)
