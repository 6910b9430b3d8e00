"""Which of the appliance's addresses a host is told.

It is the one the host reached us at; unless `advertise:` names another for its network, or (in a namespace of its
own, behind address translation) the machine's address that the host really used.
"""

import asyncio
import ipaddress
from collections.abc import Awaitable, Callable, Sequence

import structlog

from appliance.policy.model import Address
from appliance.rpc.front import plain_address
from appliance.rpc.server import Peer

_log = structlog.get_logger()
_ANSWER_SECONDS = 3.0
Network = ipaddress.IPv4Network | ipaddress.IPv6Network


class Addresses:
    """`advertised` are (network, address) pairs; `route_to(host)` asks for a translated address, if that can be.

    `listen` is the address that RVMaster, the faces and the relay listen on.
    """

    def __init__(
        self,
        advertised: Sequence[tuple[Network, Address]],
        route_to: Callable[[str], Awaitable[str | None]] | None,
        listen: str,
    ) -> None:
        address = plain_address(listen)
        self._listen = None if address.is_unspecified else str(address)
        self._advertised = advertised
        self._route_to = route_to
        self._routes: dict[Address, str | None] = {}

    def told_to(self, peer: Peer) -> str:
        """The address this peer is told."""
        for network, address in self._advertised:
            if peer.host in network:
                return str(address)
        # The appliance's own nodes come to a listener of their own, on loopback, where nothing else may be.
        return self._routes.get(peer.host) or self._listen or peer.local

    async def learn(self, peer: Peer) -> None:
        """Find out how this peer reaches us, once; to be awaited before `told_to`."""
        if self._route_to is None or peer.host in self._routes:
            return
        if len(self._routes) > 10_000:
            self._routes.clear()
        try:
            async with asyncio.timeout(_ANSWER_SECONDS):
                self._routes[peer.host] = await self._route_to(peer.text)
        except TimeoutError:
            _log.warning("the supervisor does not say how a host reaches us", host=peer.text)
