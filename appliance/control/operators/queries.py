"""Answer queries about the appliance: status, graph, live registrations, measurements. Queries change nothing."""

import asyncio
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any

import msgspec

import appliance
from appliance.base.clock import wall
from appliance.channel import admin
from appliance.channel.answers.graph_answers import Graph, Registration, Registrations
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
from appliance.configuration.inventory import inventory as product_inventory
from appliance.control.assembly.assembly import Parts
from appliance.control.assembly.hosts import SiteHosts
from appliance.control.assembly.monitor_states import monitors_of, monitors_status
from appliance.control.assembly.policies import Policies
from appliance.control.links.supervisor_link import Surroundings
from appliance.control.operators.measurements import measures_of
from appliance.control.operators.overview import graph_of
from appliance.features.views import states_in
from appliance.master.graph.registry import Kind, Life
from appliance.policy.live_rights import LiveRight
from appliance.policy.sections import DECIDERS
from appliance.telemetry.audit_trail import AuditTrail

_TOPIC = (Kind.PUBLICATION, Kind.SUBSCRIPTION)


@dataclass(frozen=True)
class Queries:
    """The answers to queries. `live()` returns the rights that a change of the policy may end."""

    parts: Parts
    trail: AuditTrail
    policies: Policies
    hosts: SiteHosts
    surroundings: Surroundings
    features: Callable[[], dict[str, Any]]
    audit: Callable[[dict[str, Any]], AuditState]
    clock: Callable[[], ClockState]
    queued_deliveries: Callable[[], int]
    live: Callable[[], list[LiveRight]]
    switched_off: Callable[[], list[SwitchedOff]]
    blocks: Callable[[], BlocksState]
    handled: Callable[[Status], Status]
    new_state: Callable[[], NewState | None]
    name: str = ""
    started: float = field(default_factory=wall)

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
        return graph_of(self.parts.core.registry, self.parts.endpoints.relay)

    async def monitors(self, request: admin.MonitorsWanted) -> Monitors:
        return monitors_of(self.parts.monitors, self.parts.monitor_calls.rv_state(), texts=request.texts)

    async def metrics(self, _request: admin.MetricsWanted) -> Measures:
        return measures_of(
            self.parts,
            self.trail.meter,
            self.present(),
            self.hosts.enrolment.rows(),
            self.queued_deliveries(),
        )

    async def registrations(self, _request: admin.RegistrationsWanted) -> Registrations:
        return Registrations([Registration(**live.fields()) for live in self.live()])

    def present(self) -> Status:
        return self.handled(self._status())

    def _status(self) -> Status:
        parts, registry, relay = self.parts, self.parts.core.registry, self.parts.endpoints.relay
        meter, states = self.trail.meter, self.features()
        # The appliance's own nodes are not counted; the graph leaves them out also.
        lives = [incarnation.life for incarnation in registry.all() if not incarnation.own]
        named = {
            (registration.kind, registration.resource)
            for node, registration in registry.in_order()
            if not node.own
        }
        return Status(
            name=self.name,
            version=appliance.__version__,
            since=self.started,
            master=self.surroundings.master,
            processes=self.surroundings.processes,
            isolation=self.surroundings.firewall.isolation,
            relaying="all" if parts.endpoints.relay.relay_all else "monitored",
            mediation="full" if parts.endpoints.relay.stand_ins else "monitored",
            firewall=self.surroundings.firewall.report,
            probe=self.surroundings.probe,
            policy=self._policy(),
            ipsec=self.hosts.enrolment.status(),
            monitors=monitors_status(parts.monitors),
            rosmaster="reachable" if parts.endpoints.rosmaster.whole else "being rebuilt",
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
            new_state=self.new_state(),
            last_minute=MinuteState(
                sum(meter.denied.counts().values()), meter.dropped.counts(), most_denied=meter.most_denied()
            ),
            **states_in(states, "status"),
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
            loaded=policies.in_force.loaded,
            file_refused=policies.file_refused,
        )
