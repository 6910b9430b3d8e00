"""How the appliance stands: its status, its graph, what is live, what is measured. Nothing is changed by a look."""

import asyncio
import time
from collections.abc import Callable
from dataclasses import dataclass, field

import msgspec

import appliance
from appliance.channel import admin
from appliance.channel.answers.graph_answers import (
    Graph,
    Registration,
    Registrations,
    TopicMessage,
    TopicMessages,
)
from appliance.channel.answers.inventory_answers import InUse, Inventory
from appliance.channel.answers.measures import Measures
from appliance.channel.answers.monitor_answers import Monitors
from appliance.channel.answers.status import (
    AuditState,
    ClockState,
    PolicyState,
    RecorderState,
    Status,
    SwitchedOff,
)
from appliance.control.assembly import Parts
from appliance.control.errors import SenselessError, UnknownThingError
from appliance.control.measurements import measures_of
from appliance.control.monitor_states import monitors_of, monitors_status
from appliance.control.overview import graph_of
from appliance.control.policies import Policies
from appliance.control.supervisor_link import Surroundings
from appliance.hosts.enrolment import Hosts
from appliance.master.graph.registry import Kind, Life
from appliance.policy.live_rights import Live
from appliance.policy.sections import DECIDERS

MOST_MESSAGES = 20
LONGEST_LOOK = 10.0
"""Seconds."""

ONE_LOOK = 60.0
"""Seconds in which the looks of one person into one topic are one record."""

_TOPIC = (Kind.PUBLICATION, Kind.SUBSCRIPTION)


@dataclass(frozen=True)
class Looks:
    """Each method answers the request that it takes.

    `audit()` is how the audit log stands, `clock()` the machine's clock, `recorder()` the flight recorder, `live()`
    what a change of the policy may end, `switched_off()` what does not act.
    """

    parts: Parts
    policies: Policies
    hosts: Hosts
    surroundings: Surroundings
    audit: Callable[[], AuditState]
    clock: Callable[[], ClockState]
    recorder: Callable[[], RecorderState | None]
    queued_deliveries: Callable[[], int]
    live: Callable[[], list[Live]]
    switched_off: Callable[[], list[SwitchedOff]]
    started: float = field(default_factory=time.time)
    _shown: dict[tuple[str, str], float] = field(default_factory=dict)

    async def status(self, _request: admin.StatusWanted) -> Status:
        """Processes, policy, registry, relay, firewall."""
        return self._status()

    async def inventory(self, _request: admin.InventoryWanted) -> Inventory:
        """What runs, and what it uses of the kernel."""
        from appliance.configuration.inventory import inventory  # noqa: PLC0415  only when it is asked for

        found = await asyncio.to_thread(inventory)
        around = self.surroundings
        used = InUse(
            firewall=around.firewall.report.backend,
            esp=self.hosts.status().esp,
            walls={process.role: process.walls for process in around.processes if process.walls},
            lacks=sorted({lack for process in around.processes for lack in process.lacks}),
        )
        return msgspec.structs.replace(found, in_use=used)

    async def graph(self, _request: admin.GraphWanted) -> Graph:
        """Nodes, topics and services, and what flows."""
        return graph_of(self.parts)

    async def monitors(self, request: admin.MonitorsWanted) -> Monitors:
        """All monitors with state and counters."""
        return monitors_of(self.parts.monitors, self.parts.monitor_calls.rv_state(), texts=request.texts)

    async def topic_look(self, request: admin.TopicLook, who: str) -> TopicMessages:
        """The next messages of a topic. Raises `UnknownThingError`, `SenselessError` and `TooManyLooksError`."""
        if not 1 <= request.messages <= MOST_MESSAGES or not 0 < request.seconds <= LONGEST_LOOK:
            raise SenselessError(f"ask for 1 to {MOST_MESSAGES} messages, within {LONGEST_LOOK:g} seconds")
        topic = next((topic for topic in graph_of(self.parts).topics if topic.name == request.topic), None)
        if topic is None:
            raise UnknownThingError(f"no node publishes or subscribes to {request.topic[:200]}")
        if not topic.mediated:
            raise SenselessError(
                f"the messages of {topic.name} go past the appliance (relaying: monitored), which cannot show them"
            )
        self._record_look(topic.name, who)
        seen = await self.parts.relay.look(
            topic.name, request.messages, request.seconds, latched=request.latched
        )
        registry = self.parts.registry
        rows = []
        for message in seen:
            node = registry.by_key(message.key)
            name = node.name if node is not None else ""
            rows.append(TopicMessage(message.time, name, message.size, message.fields, message.why))
        return TopicMessages(
            topic.name,
            seen[0].type if seen else topic.type,
            [publisher.node for publisher in topic.publishers],
            topic.subscribers,
            rows,
        )

    def _record_look(self, topic: str, who: str) -> None:
        """Once for whoever looks on: a plot in the console is one look."""
        now = time.monotonic()
        for key in [key for key, since in self._shown.items() if now - since >= ONE_LOOK]:
            del self._shown[key]
        if (who, topic) in self._shown:
            return
        self._shown[who, topic] = now
        self.parts.trail.happened(
            "topic looked into",
            f"messages of {topic} are shown, for {ONE_LOOK:g} seconds from now",
            category="topic",
            resource=topic,
            who=who,
            seconds=ONE_LOOK,
        )

    async def metrics(self, _request: admin.MetricsWanted) -> Measures:
        """The status, and everything that is counted."""
        return measures_of(self.parts, self._status(), self.hosts.rows(), self.queued_deliveries())

    async def registrations(self, _request: admin.RegistrationsWanted) -> Registrations:
        """Everything live that a change of the policy may end."""
        return Registrations([Registration(**live.fields()) for live in self.live()])

    def _status(self) -> Status:
        parts, registry, relay = self.parts, self.parts.registry, self.parts.relay
        # The appliance's own nodes are not of the robot, here as in the graph.
        lives = [incarnation.life for incarnation in registry.all() if not incarnation.own]
        named = {
            (registration.kind, registration.resource)
            for node, registration in registry.in_order()
            if not node.own
        }
        return Status(
            version=appliance.__version__,
            since=self.started,
            master=self.surroundings.master,
            processes=self.surroundings.processes,
            isolation=self.surroundings.firewall.isolation,
            relaying="all" if parts.mediation.relay_all else "monitored",
            mediation="full" if parts.mediation.stand_ins else "monitored",
            firewall=self.surroundings.firewall.report,
            probe=self.surroundings.probe,
            policy=self._policy(),
            ipsec=self.hosts.status(),
            monitors=monitors_status(parts.monitors),
            rosmaster="reachable" if parts.rosmaster.whole else "being rebuilt",
            relay=relay.presence,
            nodes=lives.count(Life.LIVE),
            shadows=lives.count(Life.SHADOW),
            topics=len({name for kind, name in named if kind in _TOPIC}),
            services=sum(kind is Kind.SERVICE for kind, _name in named),
            connections=len(relay.carried.connections),
            messages=relay.carried.total.messages,
            dropped=relay.carried.total.dropped,
            audit=self.audit(),
            clock=self.clock(),
            recorder=self.recorder(),
            switched_off=self.switched_off(),
        )

    def _policy(self) -> PolicyState:
        policies = self.policies
        return PolicyState(
            revision=policies.revision,
            file=str(policies.file),
            source=policies.current.file,
            who=policies.in_force.who,
            differs_from_file=policies.differs_from_file,
            warnings=len(policies.current.warnings),
            audit_only=[
                decider.name for decider in DECIDERS if policies.current.audit_only(decider.categories[0])
            ],
            confirm_by=policies.confirm_by,
        )
