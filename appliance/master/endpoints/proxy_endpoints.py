"""The two faces of every incarnation.

*Inner*: one loopback listener for ROSMaster; the path of the URI is the incarnation's key. *Outer*: a port of its
own that other nodes call. Neither reveals the node's real URI, and neither is ever another incarnation's.

What ROSMaster calls at an inner face is acknowledged, and nothing follows from it. What nodes are told is made by
`graph` when a call that was decided is carried out: lists of publishers from the registry, values of parameters from
the call's key and value, the order to shut down from who took the name. What ROSMaster says of these is a claim, which
needs no reading: ROSMaster joins the names in a value into keys that nobody was asked about, and its threads come late.
"""

from collections.abc import Callable
from dataclasses import dataclass, field

from appliance.master.endpoints.endpoint_addresses import NoPortError, Places
from appliance.master.graph.registry import PUBLISHER_PATH, Durable, Incarnation, Registry, SaveNode
from appliance.policy.model import Address
from appliance.rpc.connection_table import Visitors
from appliance.rpc.fair_queue import Turns
from appliance.rpc.front import HttpLimits
from appliance.rpc.processor_time import ProcessorTime
from appliance.rpc.server import Handler, HttpRequest, HttpServer, Peer, Refusal
from roswire.uris import node_uri
from roswire.xmlrpc import build_fault, build_response


@dataclass(frozen=True, slots=True)
class Faces:
    """Opens and closes faces. `serve(incarnation)` makes the handler of an outer face."""

    registry: Registry
    places: Places
    inner_port: int
    serve: Callable[[Incarnation], Handler]
    limits: HttpLimits
    visitors: Visitors[Address]
    turns: Turns
    time: ProcessorTime
    refuse: Callable[[Peer], Refusal | None]
    troubled: Callable[[Peer, str], None]
    servers: dict[str, HttpServer] = field(default_factory=dict, init=False)

    def inner_uri(self, incarnation: Incarnation) -> str:
        """What ROSMaster knows the incarnation by."""
        return node_uri("127.0.0.1", self.inner_port, f"/{incarnation.key}/")

    def nobody(self) -> str:
        """An inner URI that is no incarnation's: for unregistering what was never registered."""
        return node_uri("127.0.0.1", self.inner_port, "/nobody/")

    def by_inner_uri(self, text: str) -> Incarnation | None:
        """The incarnation of an inner URI that ROSMaster gave back."""
        return self.registry.by_key(text.rstrip("/").rpartition("/")[2])

    async def open(self, incarnation: Incarnation) -> None:
        """Serve the outer face. Raises `NoPortError`; the ports are closed then."""
        try:
            sock = self.places.socket(incarnation.outer_port).dup()
        except OSError as error:
            self.places.close(incarnation)
            raise NoPortError(f"no face for {incarnation.name}: {error.strerror}") from error
        server = HttpServer(
            sock,
            self.serve(incarnation),
            limits=self.limits,
            visitors=self.visitors,
            turns=self.turns,
            time=self.time,
            refuse=self.refuse,
            troubled=self.troubled,
        )
        self.servers[incarnation.key] = server
        await server.start()

    async def reopen(self, incarnation: Incarnation) -> list[Durable]:
        """Serve the faces of an incarnation that was restored; keep it if its ports are others now.

        Raises `NoPortError` when a port is taken.
        """
        ports = incarnation.ports
        if not self.places.reopen(incarnation):
            raise NoPortError(f"a port of {incarnation.name} is in use by another program")
        await self.open(incarnation)
        return [SaveNode(incarnation)] if incarnation.ports != ports else []

    def close(self, incarnation: Incarnation) -> None:
        """Close the outer face and all its ports, once: afterwards the ports may be another incarnation's."""
        server = self.servers.pop(incarnation.key, None)
        if server is not None:
            server.close()
            self.places.close(incarnation)

    def close_all(self) -> None:
        """Stop serving; the ports stay open for the next control."""
        for server in self.servers.values():
            server.close()


def key_of(request: HttpRequest) -> str:
    """The key in the path of a call to the inner face."""
    return request.path.strip("/")


class InnerFace:
    """Serves ROSMaster's calls to nodes. The path is the incarnation's key, which only ROSMaster was ever told."""

    def __init__(self, registry: Registry) -> None:
        self._registry = registry

    async def handle(self, request: HttpRequest) -> bytes:
        """As `acknowledge`, for a server's handler."""
        return self.acknowledge(request)

    def acknowledge(self, request: HttpRequest) -> bytes:
        """Acknowledge one call of ROSMaster."""
        if request.path != PUBLISHER_PATH and self._registry.by_key(key_of(request)) is None:
            return build_fault(1, "nobody is here")
        return build_response([1, "", 0])
