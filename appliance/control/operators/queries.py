"""Answer queries about the appliance: status, graph, live registrations, measurements. Queries change nothing."""

import asyncio
from collections import Counter
from collections.abc import Callable, Iterable, Iterator, Mapping
from dataclasses import dataclass, field
from typing import Any, TypeVar

import msgspec
from msgspec.structs import asdict

import appliance
from appliance.base.clock import Began, now, wall
from appliance.base.validation_messages import meant
from appliance.channel import admin
from appliance.channel.answers.graph_answers import (
    Connection,
    Graph,
    Node,
    Publisher,
    Registration,
    Registrations,
    Service,
    Topic,
)
from appliance.channel.answers.host_answers import Host
from appliance.channel.answers.inventory_answers import InUse, Inventory
from appliance.channel.answers.measures import Measures
from appliance.channel.answers.monitor_answers import Monitors
from appliance.channel.answers.status import (
    AuditState,
    BlocksState,
    ClockState,
    MinuteState,
    NewState,
    PolicyState,
    Status,
    SwitchedOff,
)
from appliance.channel.answers.token_answers import TokenEnding
from appliance.configuration.inventory import inventory as product_inventory
from appliance.control.assembly.hosts import SiteHosts
from appliance.control.assembly.monitor_states import monitors_of, monitors_status
from appliance.control.assembly.policies import Policies
from appliance.control.errors import UnknownThingError
from appliance.control.links.supervisor_link import Surroundings
from appliance.features.views import states_in
from appliance.master.endpoints.relay_control import RelayControl
from appliance.master.endpoints.traffic import MAX_RESOURCES, OTHERS, RelayTraffic
from appliance.master.graph.registry import OF_TOPICS, Incarnation, Kind, Life, Registry
from appliance.master.rosmaster import RosMaster
from appliance.policy.live_rights import LiveRight
from appliance.policy.model import Category
from appliance.policy.sections import DECIDERS
from appliance.specifications.allocation import SERVICE, TOPIC
from appliance.specifications.records import KINDS
from appliance.specifications.specification_manager import SpecificationManager
from appliance.telemetry.audit_trail import AuditTrail, Meter

# Describe the graph for operators: nodes, topics, services, connections, traffic.


def graph_of(registry: Registry, relay: RelayControl) -> Graph:
    shown = [
        incarnation
        for incarnation in registry.all()
        if incarnation.life is not Life.REPLACED and not incarnation.own and not incarnation.gone
    ]
    live = [incarnation for incarnation in shown if incarnation.life is Life.LIVE]
    names = {incarnation.key: incarnation.name for incarnation in shown}
    return Graph(
        [_node(incarnation) for incarnation in sorted(shown, key=lambda incarnation: incarnation.name)],
        _topics(registry, relay, live, names),
        _services(relay, live, names),
    )


def hosts_connected(registry: Registry, carried: RelayTraffic) -> Iterator[set[str]]:
    for connection in carried.connections.values():
        holder = registry.by_key(connection.key)
        yield {connection.host} if holder is None else {connection.host, str(holder.host)}


def _node(incarnation: Incarnation) -> Node:
    return Node(
        incarnation.name,
        str(incarnation.host),
        "live" if incarnation.life is Life.LIVE else "lost",
        publishes=sorted(incarnation.resources(Kind.PUBLICATION)),
        subscribes=sorted(incarnation.resources(Kind.SUBSCRIPTION)),
        offers=sorted(incarnation.resources(Kind.SERVICE)),
        uncallable=incarnation.reached is False,
    )


def _topics(
    registry: Registry, relay: RelayControl, live: list[Incarnation], names: dict[str, str]
) -> list[Topic]:
    connections = _connections(relay, TOPIC, names)
    topics = {
        registration.resource
        for incarnation in live
        for registration in incarnation.registrations.values()
        if registration.kind in OF_TOPICS
    }
    return [_topic(registry, relay, name, connections.get(name, [])) for name in sorted(topics)]


def topic_of(registry: Registry, relay: RelayControl, name: str) -> Topic:
    """Return a topic without its connections. Raises `UnknownThingError`."""
    topic = _topic(registry, relay, name, [])
    if topic.publishers or topic.subscribers:
        return topic
    names = {
        resource
        for kind, resource, holders in registry.resources()
        if kind in OF_TOPICS and any(not node.own for node in holders)
    }
    near = meant(name, names) or ": rosrv topic list shows all topics"
    raise UnknownThingError(f"no node publishes or subscribes to {name[:200]}{near}")


def _topic(registry: Registry, relay: RelayControl, name: str, connections: list[Connection]) -> Topic:
    publishing, subscribing = (
        registry.registrants(Kind.PUBLICATION, name),
        registry.registrants(Kind.SUBSCRIPTION, name),
    )
    return Topic(
        name,
        registry.type_of(name),
        mediated=relay.carries_topic(name),
        publishers=[
            Publisher(**asdict(relay.carried.flow(node.key, name)), node=node.name)
            for node in publishing
            if not node.own
        ],
        subscribers=[node.name for node in subscribing if not node.own],
        connections=connections,
    )


def _services(relay: RelayControl, live: list[Incarnation], names: dict[str, str]) -> list[Service]:
    connections = _connections(relay, SERVICE, names)
    return [
        Service(
            **asdict(relay.carried.flow(incarnation.key, registration.resource)),
            name=registration.resource,
            node=incarnation.name,
            mediated=relay.carries_service(registration.resource),
            connections=connections.get(registration.resource, []),
        )
        for incarnation in live
        for registration in incarnation.registrations.values()
        if registration.kind is Kind.SERVICE
    ]


def _connections(relay: RelayControl, kind: str, names: dict[str, str]) -> dict[str, list[Connection]]:
    connections: dict[str, list[Connection]] = {}
    for connection in relay.carried.connections.values():
        if connection.kind == kind and connection.key in names:
            row = Connection(names[connection.key], connection.caller_id, connection.host)
            connections.setdefault(connection.resource, []).append(row)
    return connections


# Collect the measurements of control. The api formats them for Prometheus.


_Labels = tuple[str, str]
_Number = TypeVar("_Number", int, float)
_DECISIONS = tuple(
    (category.value, outcome) for category in Category for outcome in ("allow", "deny", "would deny", "ask")
)


def measures_of(
    registry: Registry,
    carried: RelayTraffic,
    monitors: SpecificationManager,
    meter: Meter,
    status: Status,
    *,
    hosts: list[Host],
    queued_deliveries: int,
) -> Measures:
    """Return the measurements, with the names of `SeriesNames`."""
    lives = Counter(one.life for one in registry.all() if not one.own and not one.gone)
    kinds = Counter(registration.kind.value for node, registration in registry.in_order() if not node.own)
    records = monitors.records
    relayed, delayed = carried_of(carried)
    done = from_zero(records.counts, ((kind, name) for name in monitors.names() for kind in KINDS))
    return Measures(
        status=status,
        hosts=hosts,
        queued_deliveries=queued_deliveries,
        decisions=[(*labels, count) for labels, count in from_zero(meter.decisions, _DECISIONS).items()],
        decision_seconds=meter.decision_seconds.values(),
        calls=[(call, histogram.values()) for call, histogram in meter.calls.items()],
        nodes={"live": lives[Life.LIVE], "lost": lives[Life.SHADOW]},
        registrations=dict(kinds),
        relayed=relayed,
        delayed=delayed,
        monitors=[(*labels, count) for labels, count in done.items()],
        slices={
            name: (row.slices, row.slice_limit)
            for name, row in monitors.rollout.rows.items()
            if row.slice_limit
        },
        drop_at=_at(records.at, "drop"),
        change_at=_at(records.at, "change"),
        limited=[(*labels, count) for labels, count in carried.limited_messages.items()],
        memory={
            what: sum(held.get(what, 0) for held in carried.memory.values())
            for what in ("frames", "queues", "latched", "headers")
        },
        connections=dict(Counter(connection.kind for connection in carried.connections.values())),
    )


def _at(counts: Mapping[_Labels, int], kind: str) -> dict[str, int]:
    sums = by_resource((resource, (count,)) for (what, resource), count in counts.items() if what == kind)
    return {resource: count for resource, (count,) in sums.items()}


def carried_of(carried: RelayTraffic) -> tuple[dict[str, list[int]], dict[str, list[float]]]:
    present = carried.traffic.values()
    counted = (*carried.counted.past.items(), *((row.name, row) for row in present))
    delayed = (*carried.delayed.past.items(), *((row.delay_name, row) for row in present))
    most = MAX_RESOURCES + 1  # with `OTHERS`
    return (
        by_resource(((name, (row.messages, row.bytes, row.dropped)) for name, row in counted), most),
        by_resource(
            ((name, (*row.delays, row.delay_seconds)) for name, row in delayed if row.delays and name), most
        ),
    )


def from_zero(counts: Mapping[_Labels, int], expected: Iterable[_Labels]) -> dict[_Labels, int]:
    """Add 0 for events that have not happened yet, because a Prometheus counter must start at 0."""
    return dict.fromkeys(expected, 0) | dict(counts)


def by_resource(
    rows: Iterable[tuple[str, tuple[_Number, ...]]], most: int = MAX_RESOURCES
) -> dict[str, list[_Number]]:
    sums: dict[str, list[_Number]] = {}
    for resource, values in rows:
        name = resource if resource in sums or len(sums) < most else OTHERS
        row = sums.setdefault(name, [0] * len(values))
        for place, more in enumerate(values):
            row[place] += more
    return sums


_START_SECONDS = 10.0
_TOPIC = (Kind.PUBLICATION, Kind.SUBSCRIPTION)


@dataclass(frozen=True)
class Queries:
    """The answers to queries. `live()` returns the rights that a change of the policy may end."""

    registry: Registry
    relay: RelayControl
    rosmaster: RosMaster
    specifications: SpecificationManager
    trail: AuditTrail
    policies: Policies
    hosts: SiteHosts
    surroundings: Surroundings
    rv_state: Callable[[], list[object]]
    features: Callable[[], dict[str, Any]]
    audit: Callable[[dict[str, Any]], AuditState]
    clock: Callable[[], ClockState]
    queued_deliveries: Callable[[], int]
    live: Callable[[], list[LiveRight]]
    switched_off: Callable[[], list[SwitchedOff]]
    blocks: Callable[[], BlocksState]
    handled: Callable[[Status], Status]
    new_state: Callable[[], NewState | None]
    tokens_ending: Callable[[], list[TokenEnding]]
    name: str = ""
    started: Began = field(default_factory=Began)
    began: float = field(default_factory=now)

    async def status(self, _request: admin.StatusWanted) -> Status:
        return self.present()

    async def inventory(self, _request: admin.InventoryWanted) -> Inventory:
        found = await asyncio.to_thread(product_inventory)
        around = self.surroundings
        sandbox = {process.role: process.sandbox for process in around.processes if process.sandbox}
        used = InUse(
            firewall=around.firewall.report.backend,
            esp=self.hosts.enrolment.status().esp,
            sandbox=sandbox,
            lacks=sorted({lack for process in around.processes for lack in process.lacks}),
        )
        return msgspec.structs.replace(found, in_use=used)

    async def graph(self, _request: admin.GraphWanted) -> Graph:
        return graph_of(self.registry, self.relay)

    async def monitors(self, request: admin.MonitorsWanted) -> Monitors:
        return monitors_of(self.specifications, self.rv_state(), texts=request.texts)

    async def metrics(self, _request: admin.MetricsWanted) -> Measures:
        return measures_of(
            self.registry,
            self.relay.carried,
            self.specifications,
            self.trail.meter,
            self.present(),
            hosts=self.hosts.enrolment.rows(),
            queued_deliveries=self.queued_deliveries(),
        )

    async def registrations(self, _request: admin.RegistrationsWanted) -> Registrations:
        return Registrations([Registration(**live.fields()) for live in self.live()])

    def present(self) -> Status:
        return self.handled(self._status())

    def _status(self) -> Status:
        registry, relay, meter, states = self.registry, self.relay, self.trail.meter, self.features()
        # The graph leaves the same nodes out.
        lives = [one.life for one in registry.all() if not one.own and not one.gone]
        named = {
            (registration.kind, registration.resource)
            for node, registration in registry.in_order()
            if not node.own
        }
        return Status(
            name=self.name,
            version=appliance.__version__,
            since=self.started.date(),
            master=self.surroundings.master,
            processes=self.surroundings.processes,
            isolation=self.surroundings.firewall.isolation,
            relaying="all" if relay.relay_all else "monitored",
            mediation="full" if relay.stand_ins else "monitored",
            firewall=self.surroundings.firewall.report,
            probe=self.surroundings.probe,
            policy=self._policy(),
            ipsec=self.hosts.enrolment.status(),
            monitors=monitors_status(self.specifications),
            rosmaster="reachable" if self.rosmaster.whole else "being rebuilt",
            relay=relay.presence,
            nodes=lives.count(Life.LIVE),
            shadows=lives.count(Life.SHADOW),
            topics=len({name for kind, name in named if kind in _TOPIC}),
            services=sum(kind is Kind.SERVICE for kind, _name in named),
            connections=len(relay.carried.connections),
            messages=relay.carried.total.messages,
            dropped=relay.carried.total.dropped,
            audit=self.audit(states_in(states, "audit")),
            clock=self.clock(),
            switched_off=self.switched_off(),
            blocks=self.blocks(),
            starting=now() - self.began < _START_SECONDS,
            new_state=self.new_state(),
            tokens_ending=self.tokens_ending(),
            now=wall(),
            last_minute=MinuteState(
                sum(meter.denied.counts().values()),
                meter.dropped.counts(),
                most_denied=meter.most_denied(self.policies.in_words),
            ),
            **states_in(states, "status"),
        )

    def _policy(self) -> PolicyState:
        policies = self.policies
        differs, refused = policies.look_at_file()
        return PolicyState(
            revision=policies.revision,
            file=str(policies.file),
            source=policies.current.file,
            who=policies.in_force.who,
            differs_from_file=differs,
            warnings=len(policies.current.warnings),
            audit_only=[
                decider.name for decider in DECIDERS if policies.current.audit_only(decider.categories[0])
            ],
            confirm_by=policies.confirm_by,
            loaded=policies.in_force.loaded,
            file_refused=refused,
        )
