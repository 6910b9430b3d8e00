"""Serve the two endpoints of every incarnation. Neither endpoint reveals the node's real URI.

The *inner* (master-side) endpoint is for the ROS master: one loopback listener serves all incarnations, whose keys
are the paths of its URIs. The *outer* (peer-side) endpoint has its own port.

The ROS master's calls are acknowledged and ignored: it joins the names in a value to keys that the policy did not
decide. `Subscribers` calls the nodes instead.
"""

import socket
from collections.abc import Callable
from dataclasses import dataclass, field

from appliance.master.endpoints.node_ports import NodePorts, NoPortError
from appliance.master.graph.registry import PUBLISHER_PATH, Incarnation, Registry
from appliance.rpc.server import Handler, HttpRequest, HttpServer
from roswire.uris import node_uri
from roswire.xmlrpc import build_fault, build_response


@dataclass(frozen=True, slots=True)
class ProxyEndpoints:
    """The open endpoints. `serve()(incarnation)` makes the handler of an endpoint."""

    registry: Registry
    places: NodePorts
    inner_port: int
    serve: Callable[[], Callable[[Incarnation], Handler]]
    server: Callable[[socket.socket, Handler], HttpServer]
    servers: dict[str, HttpServer] = field(default_factory=dict, init=False)

    def inner_uri(self, incarnation: Incarnation) -> str:
        return node_uri("127.0.0.1", self.inner_port, f"/{incarnation.key}/")

    async def open(self, incarnation: Incarnation) -> None:
        """Serve an incarnation; if this fails, close its ports and raise `NoPortError`."""
        try:
            sock = self.places.socket(incarnation.outer_port).dup()
        except OSError as error:
            self.places.close(incarnation)
            raise NoPortError(f"no proxy endpoint for {incarnation.name}: {error.strerror}") from error
        server = self.server(sock, self.serve()(incarnation))
        self.servers[incarnation.key] = server
        await server.start()

    async def reopen(self, incarnation: Incarnation) -> None:
        ports = incarnation.ports
        if not self.places.reopen(incarnation):
            raise NoPortError(f"a port of {incarnation.name} is in use by another program")
        await self.open(incarnation)
        if incarnation.ports != ports:
            self.registry.mark(incarnation)

    def close(self, incarnation: Incarnation) -> None:
        server = self.servers.pop(incarnation.key, None)
        if server is not None:
            server.close()
            self.places.close(incarnation)

    def close_all(self) -> None:
        """Stop serving; the ports stay open for the next control process."""
        for server in self.servers.values():
            server.close()


class MasterSideApi:
    """Serves the ROS master's calls to nodes. The path is the incarnation's key, which no other host knows."""

    def __init__(self, registry: Registry) -> None:
        self._registry = registry

    async def handle(self, request: HttpRequest) -> bytes:
        if request.path != PUBLISHER_PATH and self._registry.by_key(request.path.strip("/")) is None:
            return build_fault(1, "this address serves no calls")
        return build_response([1, "", 0])
