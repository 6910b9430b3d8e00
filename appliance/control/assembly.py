"""Makes the parts of RVMaster and connects them.

Each is made from those before it. What changes the graph returns what follows from it, and `Enactor` carries that
out, so that no part calls one that is made after it; but for the faces, which serve calls and are closed by some.
"""

import asyncio
import socket
from collections import Counter
from collections.abc import Mapping
from dataclasses import dataclass

import structlog

from appliance.channel import messages
from appliance.config import Settings
from appliance.control.doors import Doors, value_limits
from appliance.control.lifeline import ControlLifeline
from appliance.hosts.hosts import Hosts
from appliance.master import rosout
from appliance.master.calls.call import Table, served
from appliance.master.calls.execution import Execution
from appliance.master.calls.gate import Gate, HostLimits
from appliance.master.calls.lookups import LookupCalls
from appliance.master.calls.monitor_calls import MonitorCalls
from appliance.master.calls.multicall import Multicall
from appliance.master.calls.node_calls import NODE_CALLS, NodeCalls
from appliance.master.calls.parameter_rights import ParameterRights
from appliance.master.calls.parameter_search import ParameterSearch
from appliance.master.calls.parameters import ParameterCalls
from appliance.master.calls.pipeline import Pipeline
from appliance.master.calls.registration import RegistrationCalls
from appliance.master.calls.table import MASTER_CALLS, master_table
from appliance.master.graph.delivery import Delivery
from appliance.master.graph.enactor import Enactor
from appliance.master.graph.entries import Entries
from appliance.master.graph.grants import Grants
from appliance.master.graph.graph import Graph
from appliance.master.graph.liveness import Liveness, LivenessSettings, Watchlist
from appliance.master.graph.publisher import OwnPublisher
from appliance.master.graph.reconcile import Reconciler
from appliance.master.graph.registry import Life, Registry
from appliance.master.graph.reminders import Reminders
from appliance.master.graph.revocation import Revocation, revoked
from appliance.master.parameter_charges import ParameterCharges
from appliance.master.parameter_mirror import ParameterMirror
from appliance.master.policies import Policies
from appliance.master.reach.addresses import Addresses
from appliance.master.reach.arrivals import Arrivals
from appliance.master.reach.carried import Carried
from appliance.master.reach.faces import Faces
from appliance.master.reach.inner import InnerFace
from appliance.master.reach.mediation import Mediation
from appliance.master.reach.moving import Moving
from appliance.master.reach.places import Places
from appliance.master.reach.relays import RelayControl
from appliance.master.roscore import own_parameters
from appliance.master.rosmaster import RosMaster, limits_of_answers
from appliance.master.standing import HostStanding
from appliance.policy import Policy
from appliance.policy.model import Address
from appliance.recorder import Recorder
from appliance.ros.standard import standard_definitions
from appliance.rpc.bulk import bulk_turns
from appliance.shares.pool import Pool
from appliance.shares.table import PARAMETER_BYTES
from appliance.specifications.monitors import Monitors
from appliance.store.state import StateStore

RVMASTER, INNER = "rvmaster", "inner"

_log = structlog.get_logger()


@dataclass(frozen=True, slots=True)
class Foundation:
    """What is there before the parts: settings, durable state, policy, specifications, and the listeners.

    `parameters_dirty` is set when the mirror of the parameters has changed.
    """

    settings: Settings
    lifeline: ControlLifeline
    store: StateStore
    recorder: Recorder
    policies: Policies
    monitors: Monitors
    hosts: Hosts
    registry: Registry
    standing: HostStanding
    doors: Doors
    sockets: Mapping[str, socket.socket]
    parameters_dirty: asyncio.Event

    def port(self, name: str) -> int:
        """The port of a listener."""
        return int(self.sockets[name].getsockname()[1])


@dataclass(frozen=True, slots=True)
class Parts:
    """The parts that control itself starts, asks, restores and ends; `table` is the Master API."""

    registry: Registry
    recorder: Recorder
    monitors: Monitors
    places: Places
    delivery: Delivery
    relay: RelayControl
    revocation: Revocation
    grants: Grants
    mediation: Mediation
    graph: Graph
    enactor: Enactor
    rosmaster: RosMaster
    faces: Faces
    parameters: ParameterMirror
    liveness: Liveness
    reminders: Reminders
    reconciler: Reconciler
    publisher: OwnPublisher
    monitor_calls: MonitorCalls
    table: Table
    pipeline: Pipeline
    inner: InnerFace


def assemble(base: Foundation) -> Parts:
    """All parts, each made from those before it; nothing serves yet."""
    settings, registry, recorder = base.settings, base.registry, base.recorder
    policies, monitors, values = base.policies, base.monitors, value_limits(base.settings)
    port, offload = base.port(RVMASTER), int(base.settings.limits.offload_bytes)
    # What decides, and touches nothing.
    carried = Carried(recorder, registry, settings.relays)
    grants = Grants(carried.used)
    mediation = Mediation(
        lambda: policies.current,
        lambda: monitors.checked,
        relay_all=settings.relaying == "all",
        stand_ins=settings.mediation == "full",
    )
    rights = ParameterRights(lambda: policies.current, recorder)
    graph = Graph(registry, grants, mediation, may_be_told=rights.may_be_told)
    host_limits = HostLimits(settings.limits.nodes_per_host, settings.limits.topics_per_host)
    gate = Gate(lambda: policies.current, registry, host_limits)
    mirror = _make_mirror(base)
    revocation = Revocation(registry, grants, graph, lambda: policies.current, lambda: mirror.tree)
    # What nodes, relays and ROSMaster are reached by.
    places = Places(
        settings.listen_address[0],
        policies.current.ports,
        keep=base.lifeline.keep,
        drop=base.lifeline.drop,
        named_as=lambda host: policies.current.named_as(host),  # noqa: PLW0108 - the one in force then
        relays=settings.relays,
    )
    addresses = Addresses(
        [(one.network, one.address) for one in settings.advertise],
        base.lifeline.route_to if settings.isolation == "netns" else None,
        base.sockets[RVMASTER].getsockname()[0],
    )
    watchlist = Watchlist()
    delivery = Delivery(
        timeout=settings.limits.node_call_seconds,
        limits=values,
        troubled=watchlist.could_not_tell,
        standing=base.standing,
    )
    relay = RelayControl(
        registry,
        grants,
        places,
        delivery,
        carried,
        allocation=monitors.allocation,
        policy=lambda: policies.current,
        broken=watchlist.look_at,
    )
    rosmaster = RosMaster(
        settings.rosmaster_port,
        limits=limits_of_answers(values, int(settings.limits.parameter_bytes)),
        small={call.name for call in MASTER_CALLS.values() if call.small},
    )
    faces = Faces(
        registry,
        places,
        inner_port=base.port(INNER),
        serve=lambda incarnation: pipeline.handler(node_table, target=incarnation),
        limits=base.doors.http,
        visitors=base.doors.visitors,
        turns=base.doors.turns,
        refuse=base.doors.refuse,
        troubled=base.doors.troubled,
    )
    entries = Entries(rosmaster, faces.inner_uri)
    enactor = Enactor(
        graph,
        entries,
        store=base.store,
        recorder=recorder,
        delivery=delivery,
        relay=relay,
        faces=faces,
        places=places,
    )
    # What acts by itself.
    liveness = Liveness(
        registry,
        graph,
        revocation,
        enactor,
        watchlist,
        settings=LivenessSettings(
            settings.liveness.interval,
            settings.liveness.silent,
            settings.liveness.shadow,
            settings.limits.node_call_seconds,
        ),
        limits=values,
        standing=base.standing,
    )
    reconciler = Reconciler(
        rosmaster,
        entries,
        registry,
        faces,
        graph,
        revocation,
        enactor,
        mirror,
        recorder,
        own_parameters=own_parameters,
    )
    reminders = Reminders(registry, relay, graph, enactor)
    # The calls, and what they are carried out with.
    arrivals = Arrivals(registry, graph, enactor, liveness, places=places, faces=faces, addresses=addresses)
    registration = RegistrationCalls(
        rosmaster, registry, graph, enactor, faces, arrivals, relay, mediation, gate, rights
    )
    lookups = LookupCalls(
        rosmaster,
        registry,
        graph,
        enactor,
        relay,
        mediation,
        addresses,
        port,
        stop=lambda reason: base.lifeline.say(messages.ApplianceStopRequested(reason)),
        unseen=settings.publish_as if settings.hide_publisher else None,
    )
    parameters = ParameterCalls(rosmaster, mirror, graph, enactor, rights, offload)
    search = ParameterSearch(rosmaster, mirror, rights)
    monitor_calls = MonitorCalls(monitors, registry, relay, rosmaster.port, port)
    node_calls = NodeCalls(registry, graph, enactor, relay, mediation, addresses, liveness, gate, port)
    node_table = served(NODE_CALLS.values(), node_calls)
    execution = Execution(
        gate=gate,
        policy=lambda: policies.current,
        recorder=recorder,
        registry=registry,
        enactor=enactor,
        liveness=liveness,
        parameters=parameters,
        redecide_for=lambda host, name: enactor.carry_out(revocation.redecide_for(host, name)),
        large=offload,
        standing=base.standing,
    )
    pipeline = Pipeline(
        execution,
        Multicall(execution, parameters, recorder, offload=offload),
        addresses=addresses,
        recorder=recorder,
        limits=values,
        offload=offload,
        bulk=bulk_turns(base.standing),
    )
    publisher = OwnPublisher(
        registry,
        graph,
        enactor,
        entries,
        name=settings.publish_as,
        inner_port=base.port(INNER),
        wanted=lambda: _published(base),
        register=registration.register_publisher,
    )
    parts = Parts(
        registry=registry,
        recorder=recorder,
        monitors=monitors,
        places=places,
        delivery=delivery,
        relay=relay,
        revocation=revocation,
        grants=grants,
        mediation=mediation,
        graph=graph,
        enactor=enactor,
        rosmaster=rosmaster,
        faces=faces,
        parameters=mirror,
        liveness=liveness,
        reminders=reminders,
        reconciler=reconciler,
        publisher=publisher,
        monitor_calls=monitor_calls,
        table=master_table(registration, lookups, parameters, search, monitor_calls),
        pipeline=pipeline,
        inner=InnerFace(registry),
    )
    _connect(base, parts, revocation)
    return parts


def _make_mirror(base: Foundation) -> ParameterMirror:
    whole = int(base.settings.limits.parameter_bytes)
    bounds = PARAMETER_BYTES.bounds.sized(whole, whole // 2)
    pool = Pool("bytes of parameters", bounds, base.standing)
    return ParameterMirror(
        base.store.load_parameters(),
        base.parameters_dirty.set,
        ParameterCharges(pool, base.store, base.store.parameter_owners()),
        depth_limit=base.settings.limits.nesting,
        note=base.store.note_parameter,
        since=base.store.parameter_changes(),
    )


def _connect(base: Foundation, parts: Parts, revocation: Revocation) -> None:
    """What policy, hosts and specifications call when they change."""
    relay, enactor = parts.relay, parts.enactor
    base.monitors.connect(Moving(relay, parts.graph, enactor, parts.reminders))
    relay.statement, relay.heard, relay.lost = (
        base.monitors.statement, base.monitors.received, base.monitors.relay_lost,
    )  # fmt: skip
    base.monitors.published = parts.publisher.wake
    if base.settings.monitors_on_rosout:
        relay.own_header = rosout.header(standard_definitions())
        said = rosout.Rosout(
            base.settings.publish_as, relay.publish, lambda name: base.monitors.checked.monitors.get(name, "")
        )
        base.monitors.records.told = said.reported

    def expel(host: Address, reason: str) -> int:
        effects = revocation.expel(host, reason)
        enactor.carry_out(effects)
        return revoked(effects)

    in_force = base.policies.current

    def policy_changed(policy: Policy) -> int:
        nonlocal in_force
        before, in_force = in_force, policy
        effects = revocation.policy_changed(before, policy)
        enactor.carry_out(effects)
        return revoked(effects)

    base.hosts.changed, base.hosts.expel = base.policies.hosts_changed, expel
    base.hosts.ports.machines = lambda: Counter(
        str(one.host) for one in base.registry.all() if one.life is Life.LIVE and not one.own
    )
    base.policies.changed = policy_changed


def _published(base: Foundation) -> dict[str, str]:
    """The topics that the appliance's own publisher has, and their types."""
    own = {rosout.TOPIC: rosout.TYPE} if base.settings.monitors_on_rosout else {}
    return own | base.monitors.checked.publications
