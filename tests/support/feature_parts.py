import tempfile
from pathlib import Path
from typing import Any

from appliance.audit.log.log import AuditLog
from appliance.channel.answers.graph_answers import Graph, Topic
from appliance.channel.answers.status import Status
from appliance.configuration.config_sources import read
from appliance.control.assembly.active_role import ActiveRole
from appliance.control.assembly.host_blocks import BlockTable
from appliance.control.assembly.hosts import HostAuthority, SiteHosts, make_host_table
from appliance.control.assembly.policies import Policies
from appliance.control.assembly.services import CallHolder, Provided
from appliance.control.core import (
    Alarms,
    Bearers,
    Core,
    GraphFacts,
    Links,
    OwnServices,
    PolicyFacts,
    Registrar,
    RelayOrders,
    ResourceUses,
    RestServices,
)
from appliance.control.feature_parts import FeatureParts
from appliance.control.links.supervisor_link import ControlLifeline
from appliance.control.operators.handled_alarms import HandledAlarms
from appliance.control.operators.node_connections import NodeConnections
from appliance.features.table import NAMES, member
from appliance.hosts.appliances import Appliances
from appliance.hosts.certificate_requests import StoredAuthority
from appliance.hosts.tunnel_state import Tunnels
from appliance.master.calls.parameter_calls import ParameterCalls
from appliance.master.endpoints.host_signs import HostSigns
from appliance.master.endpoints.relay_control import RankStates, RelayControl
from appliance.master.endpoints.topic_taps_control import TapRequests
from appliance.master.graph.graph import RosGraph
from appliance.master.graph.registry import Registry
from appliance.master.reconcile.subscribers import Subscribers
from appliance.policy.policy import CurrentPolicy
from appliance.policy.policy_compiler import compile_policy
from appliance.specifications.in_force import InForce
from appliance.specifications.specification_manager import SpecificationManager
from appliance.specifications.specification_revisions import NOTHING
from appliance.store.state_file import RevisionRow, StateStore
from appliance.telemetry.audit_trail import AuditTrail
from tests.support.answers import example
from tests.support.ends import ends_of
from tests.support.engines import InlineDatabase
from tests.support.idle import idle

EMPTY = "[Nodes]\n[Publishers]\n[Subscribers]\n[Commands]\n"


def idle_core(state: Path) -> Core:
    """Return a core with an empty store, policy and set of specifications, whose other parts do nothing."""
    settings = read({"state": str(state)})
    store = StateStore(state, failed=print, kind=InlineDatabase)
    ends = ends_of(store, state)
    policies, trail, relay = idle(Policies), idle(AuditTrail), idle(RelayControl)
    policies.in_force = RevisionRow(0, "", "", 0.0, "", "")
    policies.policy = CurrentPolicy()
    policies.policy.set(compile_policy(EMPTY, file="policy"))
    specifications = idle(SpecificationManager)
    specifications.now, specifications.in_force = InForce(), NOTHING
    trail.audit, relay.taps = idle(AuditLog), idle(TapRequests)
    relay.ranks = RankStates(lambda _order: False)
    return Core(
        settings=settings,
        role=ActiveRole(),
        trail=trail,
        store=store,
        ends=ends,
        links=Links(idle(ControlLifeline), lambda _sequence: None),
        policy=PolicyFacts(policies, str),
        specifications=specifications,
        hosts=SiteHosts(
            BlockTable(store, ends),
            make_host_table(settings, store),
            idle(Tunnels),
            HostAuthority(idle(StoredAuthority), idle(Appliances)),
        ),
        graph=GraphFacts(
            present=lambda: Graph([], [], []),
            topic=lambda name: example(Topic, name=name),
            host_of=lambda _node: None,
            name_of=str,
            machines=dict,
            connected=tuple,
            live_rights=list,
            expel=lambda _host, _reason: 0,
            signs=HostSigns(lambda _host: False, lambda _host, _names: 0.0),
            master_port=11311,
            connections=idle(NodeConnections),
            registrar=_idle_registrar(),
        ),
        relay=RelayOrders(relay, CallHolder(), lambda: None),
        rest=RestServices(),
        own_services=OwnServices(),
        bearers=Bearers(list, lambda: None, Provided()),
        limits=ResourceUses(tuple),
        alarms=Alarms(lambda: idle(Status), idle(HandledAlarms)),
    )


def _idle_registrar() -> Registrar:
    async def call(*_call: Any) -> int:
        return 0

    async def ready() -> None: ...

    return Registrar(
        registry=Registry(),
        graph=idle(RosGraph),
        subscribers=idle(Subscribers),
        parameters=idle(ParameterCalls),
        flush=lambda: None,
        call=call,
        ready=ready,
        silence=lambda: None,
        speak=lambda: None,
    )


def idle_parts() -> FeatureParts:
    parts = FeatureParts()
    with tempfile.TemporaryDirectory() as folder:
        core = idle_core(Path(folder))
        beginning = parts.begin(core)
        try:
            beginning.send(None)  # nothing waits, so there is no loop
        except StopIteration:
            core.store.close(0)
            return parts
    raise AssertionError("a part of control waits before a policy is in force")


def answered_later() -> list[type[Any]]:
    """Return the requests that the gate of a feature answers."""
    return [
        request
        for folder in NAMES
        if member(folder, "gate", "GATE") is not None
        for request in member(folder, "requests", "REQUESTS")
    ]
