"""Make the store, the nodes, the ROS master, the relays and the endpoints agree with the registry, at each turn's end.

1. A call is answered after its changes are flushed: they are stored, and the relay has them before a peer can use
   them. If a relay cannot take a change, operators' orders wait for it (`relay_control.py`).
2. Whatever else changes the registry, `soon` flushes it before the event loop waits again.

The sinks of the store and of the endpoints are defined here. Every incarnation has two endpoints, and neither reveals
the node's real URI. The *inner* (master-side) endpoint is for the ROS master: one loopback listener serves all
incarnations, whose keys are the paths of its URIs. The *outer* (peer-side) endpoint has its own port.
"""

import asyncio
import socket
from collections.abc import Callable, Iterable, Mapping, Sequence
from contextlib import ExitStack
from dataclasses import dataclass, field
from typing import Protocol

from appliance.base import clock
from appliance.master.endpoints.node_ports import NodePorts, NoPortError
from appliance.master.endpoints.relay_control import RelayControl
from appliance.master.graph.graph import Grants, RosGraph
from appliance.master.graph.registry import (
    ENDED,
    PUBLISHER_PATH,
    Change,
    Incarnation,
    Kind,
    Life,
    NodeRegistration,
    RegistrationKey,
    Registry,
)
from appliance.master.graph.revocation import Revocation
from appliance.policy.model import Address, address_of
from appliance.policy.policy import Policy
from appliance.rpc.server import Handler, HttpRequest, HttpServer
from appliance.store.state_file import IncarnationRow, PermissionRow, RegistrationRow, StateStore
from roswire.uris import node_uri, parse_node_uri
from roswire.xmlrpc import build_fault, build_response

_TOGETHER = 1000  # changes that are written together
_SHELVED = "revoked "  # the prefix of the stored kind of a withdrawn registration


class Sink(Protocol):
    """States the wanted state of changed keys."""

    def flush(self, changed: Sequence[Change], /) -> None:
        """State what differs; `changed` has nodes first."""


@dataclass(frozen=True, slots=True)
class Sinks:
    """All sinks of the registry, in the order in which they get changes.

    The endpoints are the last, because no sink may use the ports of an ended node afterwards.
    """

    registry: Registry
    sinks: tuple[Sink, ...]

    def __post_init__(self) -> None:
        self.registry.on_change(self.soon)

    def soon(self) -> None:
        asyncio.get_running_loop().call_soon(self.flush)

    def flush(self) -> None:
        if changed := self.registry.take_changes():
            with ExitStack() as others:  # a defect of a sink takes no change from the others
                for sink in reversed(self.sinks):
                    others.callback(sink.flush, changed)


@dataclass(frozen=True, slots=True)
class Enforcement:
    """Revokes rights that are no longer allowed."""

    revocation: Revocation
    flush: Callable[[], None]
    relay: RelayControl
    places: NodePorts

    def policy_changed(self, policy: Policy) -> int:
        """Enforce a policy that is already in force. Return the number of revoked rights.

        The policy may use another range of ports, and name hosts differently.
        """
        self.places.policy_changed(policy.ports)
        count = self.revocation.redecide()
        self.flush()
        self.relay.compare()
        return count

    def expel(self, host: Address, reason: str) -> int:
        count = self.revocation.expel(host, reason)
        self.flush()
        return count

    def redecide_for(self, host: Address, caller_id: str) -> None:
        self.revocation.redecide_for(host, caller_id)
        self.flush()


# --- the store ---


@dataclass(frozen=True, slots=True)
class StoredGraph:
    """Stores the present state of what has changed."""

    grants: Grants
    store: StateStore

    def flush(self, changed: Sequence[Change]) -> None:
        """After a crash, the store has all changes of a turn or none.

        Only a turn with thousands of changes is divided, so that no other change waits for one large write.
        """
        for begin in range(0, len(changed), _TOGETHER):
            with self.store.database.together():
                for change in changed[begin : begin + _TOGETHER]:
                    self._save(change)

    def _save(self, change: Change) -> None:
        match change:
            case Incarnation(life=Life.FORGOTTEN):
                self.store.forget_incarnation(change.key)  # with its registrations and grants
            case Incarnation():
                self.store.save_incarnation(
                    IncarnationRow(
                        change.key, change.name, str(change.host), change.api_text, change.told, change.outer_port,
                        change.relay_port, change.own, change.life.value, change.changed, change.more_relay_ports,
                    )
                )  # fmt: skip
            case RegistrationKey(node, kind, resource, shelved) if node.life is not Life.FORGOTTEN:
                stored_kind = f"{_SHELVED}{kind.value}" if shelved else kind.value
                one = (node.shelf if shelved else node.registrations).get((kind, resource))
                if one is None:
                    self.store.remove_registration(node.key, stored_kind, resource)
                else:
                    self.store.save_registration(
                        RegistrationRow(node.key, stored_kind, resource, one.detail, one.order)
                    )
            case PermissionRow():
                if change in self.grants.of(change.key):
                    self.store.save_permission(change)
                else:
                    self.store.remove_permission(change)


def restore(registry: Registry, store: StateStore) -> int:
    incarnations, registrations = store.load_registry()
    by_key = {
        row.key: Incarnation(
            key=row.key,
            name=row.name,
            host=address_of(row.host),
            api=parse_node_uri(row.api),
            api_text=row.api,
            told=row.told,
            outer_port=row.outer_port,
            relay_port=row.relay_port,
            own=row.own,
            life=Life(row.life),
            changed=clock.now(),  # the stored time may be from before a restart of the machine
            more_relay_ports=row.more_relay_ports,
        )
        for row in incarnations
    }
    for row in registrations:
        owner = by_key.get(row.key)
        if owner is not None:
            kind = Kind(row.kind.removeprefix(_SHELVED))
            place = owner.shelf if row.kind.startswith(_SHELVED) else owner.registrations
            place[kind, row.resource] = NodeRegistration(kind, row.resource, row.detail, row.ordinal)
    for incarnation in by_key.values():
        registry.restore(incarnation)
    return len(by_key)


# --- the endpoints ---


@dataclass(frozen=True, slots=True)
class ProxyEndpoints:
    """The open endpoints: `server(socket, handler)` serves the outer one of an incarnation."""

    registry: Registry
    places: NodePorts
    inner_port: int
    server: Callable[[socket.socket, Handler], HttpServer]
    servers: dict[str, HttpServer] = field(default_factory=dict, init=False)

    def flush(self, changed: Iterable[Change]) -> None:
        for node in changed:
            if isinstance(node, Incarnation) and node.life in ENDED:
                self.close(node)

    def inner_uri(self, incarnation: Incarnation) -> str:
        return node_uri("127.0.0.1", self.inner_port, f"/{incarnation.key}/")

    async def open(self, incarnation: Incarnation, handler: Handler) -> None:
        """Serve an incarnation; if this fails, close its ports and raise `NoPortError`."""
        try:
            sock = self.places.socket(incarnation.outer_port).dup()
        except OSError as error:
            self.places.close(incarnation)
            raise NoPortError(f"no proxy endpoint for {incarnation.name}: {error.strerror}") from error
        server = self.server(sock, handler)
        self.servers[incarnation.key] = server
        await server.start()

    async def reopen(self, incarnation: Incarnation, handler: Handler) -> None:
        ports = incarnation.ports
        self.places.reopen(incarnation)
        await self.open(incarnation, handler)
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


async def restore_nodes(
    sockets: Mapping[str, socket.socket],
    store: StateStore,
    graph: RosGraph,
    faces: ProxyEndpoints,
    serve: Callable[[Incarnation], Handler],
) -> None:
    """Restore the stored nodes with their ports. A node that gets no port is lost."""
    places, registry = faces.places, graph.registry
    for name, sock in sockets.items():
        if name.startswith("port:"):
            places.adopt(name, sock)
    restore(registry, store)
    graph.grants.restore(store.permissions())
    claimed: set[int] = set()
    places.reserve(port for node in registry.all() for port in node.ports)
    for incarnation in registry.all():
        if incarnation.life is Life.REPLACED:
            continue
        try:
            await faces.reopen(incarnation, serve(incarnation))
        except NoPortError as error:
            graph.lost(incarnation, str(error))
            graph.forgotten(incarnation)
            continue
        claimed |= set(incarnation.ports)
    places.close_unclaimed(claimed)


class MasterSideApi:
    """Serves the ROS master's calls to nodes. The path is the incarnation's key, which no other host knows.

    The calls are acknowledged and ignored: the ROS master joins the names in a value to keys that the policy did not
    decide. `Subscribers` calls the nodes instead.
    """

    def __init__(self, registry: Registry) -> None:
        self._registry = registry

    async def handle(self, request: HttpRequest) -> bytes:
        if request.path != PUBLISHER_PATH and self._registry.by_key(request.path.strip("/")) is None:
            return build_fault(1, "this address serves no calls")
        return build_response([1, "", 0])
