"""Control's side of the relay: states what is wanted, answers where publishers are, keeps what is connected.

What is wanted is derived from the registry (nodes, publications, services) and the grants, which are kept in the
store because a ROS node never asks twice. When a relay (re)appears everything is stated afresh between
`StateBegan` and `StateEnded`; what is not said again is gone.
"""

import asyncio
import time
from collections.abc import Callable
from dataclasses import dataclass

from appliance.audit.record import Severity
from appliance.channel import messages
from appliance.channel.channel import Channel, ChannelClosedError
from appliance.channel.messages import TopicTraffic
from appliance.master.client import CallFailedError
from appliance.master.delivery import Delivery
from appliance.master.places import Places
from appliance.master.recorder import Recorder
from appliance.master.registry import Incarnation, Kind, Registry
from appliance.policy.model import Address
from appliance.ros.xmlrpc import Value
from appliance.store.state import PermissionRow, StateStore

RELAY_NAME = "/rosrv"
_GRANTS_PER_HOST = 20_000
_CLEARED_AT_ONCE = 1000
TOPIC, SERVICE = "topic", "service"
_STILL_SECONDS = 3.0  # without a report: nothing flows


@dataclass(frozen=True, slots=True)
class Connection:
    """A subscriber or client that is connected through the relay; `kind` is "topic" or "service"."""

    number: int
    key: str
    resource: str
    kind: str
    host: str
    caller_id: str


@dataclass(slots=True)
class Traffic:
    """Counters of one relayed topic or service of one incarnation, since control started."""

    messages: int = 0
    bytes: int = 0
    dropped: int = 0
    seconds: float = 0.0  # monotonic, of the last report
    messages_per_second: float = 0.0  # between the last two reports
    bytes_per_second: float = 0.0

    def add(self, row: TopicTraffic, now: float) -> None:
        """Count what the relay reported; it reports once a second, and only what changed."""
        self.messages += row.messages
        self.bytes += row.bytes
        self.dropped += row.dropped
        passed = max(now - self.seconds, 1.0) if self.seconds else 1.0
        self.messages_per_second = row.messages / passed
        self.bytes_per_second = row.bytes / passed
        self.seconds = now


class RelayControl:
    """What control knows and wants of the relay. `broken(incarnation)` hears of lost upstreams."""

    def __init__(
        self,
        registry: Registry,
        places: Places,
        store: StateStore,
        delivery: Delivery,
        recorder: Recorder,
        *,
        broken: Callable[[Incarnation], None],
    ) -> None:
        self._registry = registry
        self._places = places
        self._store = store
        self._delivery = delivery
        self._recorder = recorder
        self._broken = broken
        self._channel: Channel | None = None
        self._epoch = 0
        self._permissions: dict[str, set[PermissionRow]] = {}
        self._placed: set[str] = set()  # incarnations whose port this relay has
        self._of_host: dict[str, dict[PermissionRow, None]] = {}  # the same, in the order they were granted
        self._asking: set[asyncio.Task[None]] = set()
        self.statement: Callable[[], messages.Message | None] = lambda: (
            None
        )  # set by control when it is wired
        self.heard: Callable[[messages.Message], None] = lambda message: None  # noqa: ARG005 - the same
        self.connections: dict[int, Connection] = {}
        self.traffic: dict[tuple[str, str], Traffic] = {}

    @property
    def connected(self) -> bool:
        """Whether a relay is there."""
        return self._channel is not None

    def flow(self, key: str, resource: str) -> dict[str, float]:
        """What went and goes through a topic or service of an incarnation, in plain values."""
        traffic = self.traffic.get((key, resource), Traffic())
        flows = time.monotonic() - traffic.seconds < _STILL_SECONDS
        return {
            "messages": traffic.messages,
            "bytes": traffic.bytes,
            "dropped": traffic.dropped,
            "messages_per_second": round(traffic.messages_per_second, 2) if flows else 0.0,
            "bytes_per_second": round(traffic.bytes_per_second, 1) if flows else 0.0,
        }

    # --- the link ---

    def load(self) -> None:
        """Read the kept grants."""
        for row in self._store.permissions():
            self._permissions.setdefault(row.key, set()).add(row)
            self._of_host.setdefault(row.host, {})[row] = None

    def attach(self, channel: Channel) -> None:
        """A relay is there: serve its link and state everything."""
        if self._channel is not None:
            self._channel.close()
        self._channel = channel
        self._placed.clear()
        self.connections.clear()
        channel.attach(asyncio.get_running_loop(), self._received, lambda: self._lost(channel))
        self._epoch += 1
        specifications = self.statement()  # before anything is placed: nothing goes past the monitors
        if specifications is not None:
            self._send(specifications)
        self._send(messages.StateBegan(self._epoch))
        for incarnation in self._registry.live():
            self._place(incarnation)
        self._send(messages.StateEnded(self._epoch))

    def _lost(self, channel: Channel) -> None:
        if self._channel is channel:
            self._channel = None
            self.connections.clear()

    def _send(self, message: messages.Message, descriptors: tuple[int, ...] = ()) -> None:
        if self._channel is None:
            return  # stated afresh when there is one
        try:
            self._channel.send(message, descriptors)
        except ChannelClosedError:
            self._channel = None

    def send(self, message: messages.Message) -> bool:
        """Tell the relay; False when there is none."""
        self._send(message)
        return self._channel is not None

    # --- what is wanted ---

    def _place(self, incarnation: Incarnation) -> None:
        if not (incarnation.resources(Kind.PUBLICATION) or incarnation.resources(Kind.SERVICE)):
            return
        self._place_node(incarnation)
        for registration in incarnation.registrations.values():
            if registration.kind is Kind.PUBLICATION:
                self._send(
                    messages.PublicationPlaced(incarnation.key, registration.resource, registration.detail)
                )
            elif registration.kind is Kind.SERVICE:
                self._place_service(incarnation, registration.resource, registration.detail)
        for row in self._permissions.get(incarnation.key, ()):
            self._state(row)

    def _place_node(self, incarnation: Incarnation) -> None:
        if incarnation.key in self._placed:
            return
        self._placed.add(incarnation.key)
        listening = self._places.socket(incarnation.relay_port)
        message = messages.NodePlaced(
            incarnation.key, incarnation.name, str(incarnation.host), incarnation.of_monitors
        )
        self._send(message, (listening.fileno(),))

    def _place_service(self, incarnation: Incarnation, service: str, port: str) -> None:
        self._send(messages.ServicePlaced(incarnation.key, service, str(incarnation.host), int(port)))

    def _state(self, row: PermissionRow) -> None:
        if row.kind == TOPIC:
            self._send(messages.GrantInstalled(row.key, row.resource, row.host, row.caller_id))
        else:
            self._send(messages.ClientGranted(row.key, row.resource, row.host))

    def placed(self, incarnation: Incarnation, kind: Kind, resource: str, detail: str) -> None:
        """The incarnation registered a publication or a service."""
        if kind is Kind.PUBLICATION:
            self._place_node(incarnation)
            self._send(messages.PublicationPlaced(incarnation.key, resource, detail))
        elif kind is Kind.SERVICE:
            self._place_node(incarnation)
            self._place_service(incarnation, resource, detail)

    def withdrawn(self, incarnation: Incarnation, kind: Kind, resource: str) -> None:
        """The incarnation has a publication or a service no longer."""
        if kind is Kind.PUBLICATION:
            self._send(messages.PublicationWithdrawn(incarnation.key, resource))
        elif kind is Kind.SERVICE:
            self._send(messages.ServiceWithdrawn(incarnation.key, resource))

    def node_withdrawn(self, incarnation: Incarnation) -> None:
        """The incarnation is gone (for now): nothing of it is carried."""
        if incarnation.key in self._placed:
            self._placed.discard(incarnation.key)
            self._send(messages.NodeWithdrawn(incarnation.key))

    def node_returned(self, incarnation: Incarnation) -> None:
        """The incarnation is back with all it had."""
        self._place(incarnation)

    def forgotten(self, incarnation: Incarnation) -> None:
        """The incarnation is gone for good, its grants with it."""
        self.node_withdrawn(incarnation)
        for row in self._permissions.pop(incarnation.key, ()):
            self._drop(row)
        for key in [one for one in self.traffic if one[0] == incarnation.key]:
            del self.traffic[key]

    def unconnected(self) -> list[PermissionRow]:
        """Grants for topics of live publishers whose subscriber is not connected."""
        there = {(one.key, one.resource, one.host, one.caller_id) for one in self.connections.values()}
        return [
            row
            for incarnation in self._registry.live()
            for row in self._permissions.get(incarnation.key, ())
            if row.kind == TOPIC
            and (Kind.PUBLICATION, row.resource) in incarnation.registrations
            and (row.key, row.resource, row.host, row.caller_id) not in there
        ]

    # --- grants ---

    def permissions(self) -> list[PermissionRow]:
        """Every grant."""
        return [row for rows in self._permissions.values() for row in rows]

    def grant_topic(self, publisher: Incarnation, topic: str, host: Address, caller_id: str) -> None:
        """This subscriber may have this topic of that publisher."""
        self._grant(PermissionRow(publisher.key, TOPIC, topic, str(host), caller_id))

    def grant_service(self, provider: Incarnation, service: str, host: Address) -> None:
        """This host may call this service of that provider."""
        self._grant(PermissionRow(provider.key, SERVICE, service, str(host), ""))

    def _grant(self, row: PermissionRow) -> None:
        rows = self._permissions.setdefault(row.key, set())
        if row not in rows:
            rows.add(row)
            self._store.save_permission(row)
            mine = self._of_host.setdefault(row.host, {})
            mine[row] = None
            if len(mine) > _GRANTS_PER_HOST:
                self._clear_unused(row)
        self._state(row)

    def _clear_unused(self, newest: PermissionRow) -> None:
        """A host that asks for topics under ever new names loses its oldest grants that nobody is connected by."""
        used = {(one.key, one.kind, one.resource, one.host) for one in self.connections.values()}
        unused = [
            row
            for row in self._of_host[newest.host]
            if row != newest and (row.key, row.kind, row.resource, row.host) not in used
        ]
        for row in unused[:_CLEARED_AT_ONCE]:
            self.revoke(row)

    def _drop(self, row: PermissionRow) -> None:
        self._store.remove_permission(row)
        mine = self._of_host.get(row.host, {})
        mine.pop(row, None)
        if not mine:
            self._of_host.pop(row.host, None)

    def revoke(self, row: PermissionRow) -> None:
        """Take a grant back; its connection is cut."""
        rows = self._permissions.get(row.key, set())
        rows.discard(row)
        self._drop(row)
        if row.kind == TOPIC:
            self._send(messages.GrantRevoked(row.key, row.resource, row.host, row.caller_id))
        else:
            self._send(messages.ClientRevoked(row.key, row.resource, row.host))

    def revoke_subscriber(self, host: Address, caller_id: str, topic: str) -> None:
        """The subscriber gave the topic up: its grants for it, on every publisher, are gone."""
        for publisher in list(self._registry.registered(Kind.PUBLICATION, topic)):
            row = PermissionRow(publisher.key, TOPIC, topic, str(host), caller_id)
            if row in self._permissions.get(publisher.key, ()):
                self.revoke(row)

    # --- what the relay says ---

    def _received(self, message: messages.Message, _descriptors: tuple[int, ...]) -> None:
        match message:
            case messages.UpstreamWanted():
                task = asyncio.get_running_loop().create_task(self._find_upstream(message.key, message.topic))
                self._asking.add(task)
                task.add_done_callback(self._asking.discard)
            case messages.UpstreamLost():
                incarnation = self._registry.by_key(message.key)
                if incarnation is not None:
                    self._broken(incarnation)
            case messages.TrafficReported():
                for row in message.rows:
                    if self._registry.by_key(row.key) is None:
                        continue  # the last words about a node that is forgotten
                    self.traffic.setdefault((row.key, row.resource), Traffic()).add(row, time.monotonic())
            case messages.ConnectionOpened():
                self._opened(message)
            case messages.ConnectionClosed():
                self._closed(message)
            case messages.ConnectionRefused():
                self._refused(message)
            case messages.PublicationRefused():
                self._publication_refused(message)
            case _:
                self.heard(message)

    async def _find_upstream(self, key: str, topic: str) -> None:
        incarnation = self._registry.by_key(key)
        if incarnation is None or (Kind.PUBLICATION, topic) not in incarnation.registrations:
            self._send(messages.UpstreamRefused(key, topic, "the node does not publish this topic any more"))
            return
        try:
            answer = await self._delivery.client(incarnation).call(
                "requestTopic", RELAY_NAME, topic, [["TCPROS"]]
            )
            port = tcpros_port(answer)
        except CallFailedError as error:
            self._send(messages.UpstreamRefused(key, topic, str(error)))
            self._broken(incarnation)
            return
        self._send(messages.UpstreamFound(key, topic, str(incarnation.host), port))

    def _opened(self, message: messages.ConnectionOpened) -> None:
        connection = Connection(
            message.number, message.key, message.resource, message.kind, message.host, message.caller_id
        )
        self.connections[message.number] = connection
        self._recorder.happened(
            "connection opened",
            f"{message.caller_id} ({message.host}) is connected to {message.resource} of {self._name(message.key)}",
            host=message.host,
            caller_id=message.caller_id,
            category=message.kind,
            resource=message.resource,
            node=self._name(message.key),
        )

    def _closed(self, message: messages.ConnectionClosed) -> None:
        connection = self.connections.pop(message.number, None)
        if connection is None:
            return
        self._recorder.happened(
            "connection closed",
            message.reason or "closed in an orderly way",
            host=connection.host,
            caller_id=connection.caller_id,
            category=connection.kind,
            resource=connection.resource,
            node=self._name(connection.key),
        )

    def _refused(self, message: messages.ConnectionRefused) -> None:
        self._recorder.happened(
            "connection refused",
            message.reason,
            severity=Severity.WARNING,
            decision="deny",
            host=message.host,
            caller_id=message.caller_id,
            resource=message.resource,
            node=self._name(message.key),
            count=message.count,
        )

    def _publication_refused(self, message: messages.PublicationRefused) -> None:
        self._recorder.happened(
            "publication refused",
            message.reason,
            severity=Severity.ALARM,
            decision="deny",
            caller_id=self._name(message.key),
            category="monitor",
            resource=message.resource,
        )

    def _name(self, key: str) -> str:
        incarnation = self._registry.by_key(key)
        return incarnation.name if incarnation is not None else ""


def tcpros_port(answer: Value) -> int:
    """The port in a node's answer to `requestTopic`; the host in it is never followed."""
    match answer:
        case [1, str(), ["TCPROS", str(), int(port)]] if 0 < port < 65536:
            return port
        case [int(), str(text), *_]:
            raise CallFailedError(f"the publisher refused: {text[:200]}")
    raise CallFailedError("the publisher's answer to requestTopic is not of the ROS form")
