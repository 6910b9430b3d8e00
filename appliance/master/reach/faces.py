"""The two faces of every incarnation, and how an incarnation comes to be.

*Inner*: one loopback listener for ROSMaster; the path of the URI is the incarnation's key. *Outer*: a port of its
own that other nodes call. Neither reveals the node's real URI, and neither is ever another incarnation's.
"""

import asyncio
import time
from collections.abc import Awaitable, Callable

from appliance.master.caller import ApiUri, Caller
from appliance.master.graph.registry import Incarnation, Life, Registry, new_key
from appliance.master.reach.places import NoPortError, Places
from appliance.policy.model import Address
from appliance.ros.uris import node_uri
from appliance.rpc.front import HttpLimits
from appliance.rpc.server import Handler, HttpRequest, HttpServer, Peer, Refusal
from appliance.rpc.turns import Turns
from appliance.rpc.visitors import Visitors


class Faces:
    """Opens and closes faces. `serve(incarnation)` makes the handler of an outer face.

    `address_for(peer)` is the appliance's address that the peer is told in URIs; `revive(incarnation)` brings a
    shadow back with all it had, `forget(incarnation)` drops one for good.
    """

    def __init__(
        self,
        registry: Registry,
        places: Places,
        *,
        inner_port: int,
        serve: Callable[[Incarnation], Handler],
        address_for: Callable[[Peer], str],
        limits: HttpLimits,
        visitors: Visitors[Address],
        turns: Turns,
        refuse: Callable[[Peer], Refusal | None],
        troubled: Callable[[Peer, str], None],
        revive: Callable[[Incarnation], Awaitable[None]],
        forget: Callable[[Incarnation], None],
    ) -> None:
        self._registry = registry
        self._places = places
        self._inner_port = inner_port
        self._serve = serve
        self._address_for = address_for
        self._limits = limits
        self._visitors = visitors
        self._turns = turns
        self._refuse = refuse
        self._troubled = troubled
        self._revive = revive
        self._forget = forget
        self._servers: dict[str, HttpServer] = {}
        self._coming: dict[tuple[str, Address, str], asyncio.Future[Incarnation]] = {}

    def inner_uri(self, incarnation: Incarnation) -> str:
        """What ROSMaster knows the incarnation by."""
        return node_uri("127.0.0.1", self._inner_port, f"/{incarnation.key}/")

    def nobody(self) -> str:
        """An inner URI that is no incarnation's: for unregistering what was never registered."""
        return node_uri("127.0.0.1", self._inner_port, "/nobody/")

    def by_inner_uri(self, text: str) -> Incarnation | None:
        """The incarnation of an inner URI that ROSMaster gave back."""
        return self._registry.by_key(text.rstrip("/").rpartition("/")[2])

    def known(self, caller: Caller, api: ApiUri) -> Incarnation | None:
        """The incarnation that calls, if it is known."""
        return self._registry.find(caller.caller_id, caller.peer.host, api.text)

    async def incarnation_for(self, caller: Caller, api: ApiUri) -> Incarnation:
        """The incarnation that calls; made, with its ports and durably, when it is new.

        Raises `NoPortError` when the range of ports is exhausted.
        """
        identity = (caller.caller_id, caller.peer.host, api.text)
        incarnation = self._registry.find(*identity)
        if incarnation is not None and incarnation.life is Life.LIVE:
            incarnation.touched = time.monotonic()
            incarnation.told = self._address_for(caller.peer)
            return incarnation
        if incarnation is not None and incarnation.life is Life.SHADOW:
            if self._registry.holder(incarnation.name) is None:
                # It was away and adds to what it had, before anybody saw that it is back.
                await self._revive(incarnation)
                return incarnation
            self._forget(incarnation)  # another took its name meanwhile: it begins anew
        coming = self._coming.get(identity)
        if coming is None:
            coming = asyncio.ensure_future(self._make(caller, api))
            self._coming[identity] = coming
            coming.add_done_callback(lambda _done: self._coming.pop(identity, None))
        return await asyncio.shield(coming)

    async def _make(self, caller: Caller, api: ApiUri) -> Incarnation:
        outer_port, relay_port, *more = self._open_ports(caller.peer.host)
        incarnation = Incarnation(
            key=new_key(),
            name=caller.caller_id,
            host=caller.peer.host,
            api=api.uri,
            api_text=api.text,
            told=self._address_for(caller.peer),
            outer_port=outer_port,
            relay_port=relay_port,
            more_relay_ports=tuple(more),
            own=caller.own,
            changed=time.time(),
            touched=time.monotonic(),
        )
        self._registry.add(incarnation)
        await self.open(incarnation)
        return incarnation

    def _open_ports(self, host: Address) -> tuple[int, ...]:
        """Ports for a node of this host; who has no registration makes room at once. Raises `NoPortError`."""
        while True:
            try:
                return self._places.open(host)
            except NoPortError:
                spare = self._registry.spare(host)
                if spare is None:
                    raise
                self._forget(spare)

    async def open(self, incarnation: Incarnation) -> None:
        """Serve the outer face."""
        server = HttpServer(
            self._places.socket(incarnation.outer_port).dup(),
            self._serve(incarnation),
            limits=self._limits,
            visitors=self._visitors,
            turns=self._turns,
            refuse=self._refuse,
            troubled=self._troubled,
        )
        self._servers[incarnation.key] = server
        await server.start()

    async def reopen(self, incarnation: Incarnation) -> None:
        """Serve the faces of an incarnation that was restored. Raises `NoPortError` when a port is taken."""
        ports = incarnation.ports
        if not self._places.reopen(incarnation):
            raise NoPortError(f"a port of {incarnation.name} is in use by another program")
        if incarnation.ports != ports:
            self._registry.changed_ports(incarnation)
        await self.open(incarnation)

    def close(self, incarnation: Incarnation) -> None:
        """Close the outer face and all its ports, once: afterwards the ports may be another incarnation's."""
        server = self._servers.pop(incarnation.key, None)
        if server is not None:
            server.close()
            self._places.close(incarnation)

    def close_all(self) -> None:
        """Stop serving; the ports stay open for the next control."""
        for server in self._servers.values():
            server.close()


def key_of(request: HttpRequest) -> str:
    """The key in the path of a call to the inner face."""
    return request.path.strip("/")
