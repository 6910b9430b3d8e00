"""Makes the parts of RVMaster and connects them.

Parts need each other in circles (who delivers calls to nodes reports the dead ones to who looks after the living, and
that one delivers calls). Each builder makes some parts from those before it; what a part calls of a later one goes
through `Wires`, the one place where the circles are.
"""

import asyncio
import socket
from collections import Counter
from collections.abc import Callable, Mapping
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
from appliance.master.graph.delivery import Delivery, NodeCall
from appliance.master.graph.graph import Graph
from appliance.master.graph.liveness import Liveness, LivenessSettings
from appliance.master.graph.publisher import OwnPublisher
from appliance.master.graph.reconcile import Reconciler
from appliance.master.graph.registrar import Registrar
from appliance.master.graph.registry import Incarnation, Kind, Life, Registry
from appliance.master.graph.reminders import Reminders
from appliance.master.graph.revocation import Revocation
from appliance.master.later import Later
from appliance.master.parameter_charges import ParameterCharges
from appliance.master.parameter_mirror import ParameterMirror
from appliance.master.policies import Policies
from appliance.master.reach.addresses import Addresses
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
from appliance.recorder import Recorder
from appliance.ros.standard import standard_definitions
from appliance.rpc.bulk import bulk_turns
from appliance.rpc.server import Handler
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
class _Reach:
    """How nodes are known, found, told and carried; and what the policy lets them be told of parameters."""

    registry: Registry
    places: Places
    addresses: Addresses
    delivery: Delivery
    relay: RelayControl
    mediation: Mediation
    graph: Graph
    rights: ParameterRights


@dataclass(frozen=True, slots=True)
class _Books:
    """What holds ROSMaster, the registry and the policy together."""

    rosmaster: RosMaster
    registrar: Registrar
    faces: Faces
    mirror: ParameterMirror
    reconciler: Reconciler
    revocation: Revocation
    liveness: Liveness


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
    mediation: Mediation
    graph: Graph
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


class _Wires:
    """What earlier parts call of later ones."""

    def __init__(self) -> None:
        self.liveness: Later[Liveness] = Later("liveness")
        self.faces: Later[Faces] = Later("faces")
        self.reconciler: Later[Reconciler] = Later("the reconcile loop")
        self.node_handler: Later[Callable[[Incarnation], Handler]] = Later("the handler of outer faces")
        self.revocation: Later[Revocation] = Later("the revocation")
        self.rosmaster: Later[RosMaster] = Later("the ROS Master")

    def node_troubled(self, incarnation: Incarnation, call: NodeCall, why: str) -> None:
        _log.info("a node could not be told", node=incarnation.name, call=call.method, why=why)
        self.liveness().missed(incarnation, call)

    def look_at(self, incarnation: Incarnation) -> None:
        self.liveness().look_at(incarnation)

    def close_faces(self, incarnation: Incarnation) -> None:
        self.faces().close(incarnation)

    async def revive(self, incarnation: Incarnation) -> None:
        await self.liveness().revive(incarnation)

    def may_have(self, incarnation: Incarnation, kind: Kind, resource: str) -> bool:
        return self.revocation().may_have(incarnation, kind, resource)

    def rosmaster_lost(self) -> None:
        self.rosmaster().shut()
        self.reconciler().wake()

    def serve(self, incarnation: Incarnation) -> Handler:
        return self.node_handler()(incarnation)


def assemble(base: Foundation) -> Parts:
    """All parts, connected; nothing serves yet."""
    wires = _Wires()
    reach = _make_reach(base, wires)
    return _finish(base, wires, reach, _make_books(base, wires, reach))


def _make_books(base: Foundation, wires: _Wires, reach: _Reach) -> _Books:
    settings, registry, graph = base.settings, reach.registry, reach.graph
    faces = wires.faces.fill(_make_faces(base, wires, reach))
    rosmaster = wires.rosmaster.fill(
        RosMaster(
            settings.rosmaster_port,
            lost=wires.rosmaster_lost,
            limits=limits_of_answers(value_limits(settings), int(settings.limits.parameter_bytes)),
            small={call.name for call in MASTER_CALLS.values() if call.small},
        )
    )
    mirror = ParameterMirror(
        base.store.load_parameters(),
        base.parameters_dirty.set,
        _make_charges(base),
        depth_limit=settings.limits.nesting,
        note=base.store.note_parameter,
        since=base.store.parameter_changes(),
    )
    registrar = Registrar(rosmaster, faces)
    reconciler = wires.reconciler.fill(
        Reconciler(
            rosmaster,
            registry,
            faces,
            graph,
            mirror,
            base.recorder,
            own_parameters=own_parameters,
            may_have=wires.may_have,
        )
    )
    revocation = wires.revocation.fill(
        Revocation(
            registry,
            graph,
            reach.relay,
            registrar,
            base.recorder,
            policy=lambda: base.policies.current,
            parameters=lambda: mirror.tree,
            put_back=reconciler.put_back,
        )
    )
    liveness = wires.liveness.fill(
        Liveness(
            registry,
            graph,
            LivenessSettings(
                settings.liveness.interval,
                settings.liveness.silent,
                settings.liveness.shadow,
                settings.limits.node_call_seconds,
            ),
            value_limits(settings),
            withdraw=registrar.withdraw_lost,
            put_back=reconciler.put_back,
            returned=revocation.returned,
            standing=base.standing,
        )
    )
    return _Books(rosmaster, registrar, faces, mirror, reconciler, revocation, liveness)


def _make_charges(base: Foundation) -> ParameterCharges:
    whole = int(base.settings.limits.parameter_bytes)
    bounds = PARAMETER_BYTES.bounds.sized(whole, whole // 2)
    pool = Pool("bytes of parameters", bounds, base.standing)
    return ParameterCharges(pool, base.store, base.store.parameter_owners())


def _make_reach(base: Foundation, wires: _Wires) -> _Reach:
    settings = base.settings
    registry = base.registry
    places = Places(
        settings.listen_address[0],
        base.policies.current.ports,
        keep=base.lifeline.keep,
        drop=base.lifeline.drop,
        named_as=lambda host: base.policies.current.named_as(host),  # noqa: PLW0108 - the one in force then
        relays=settings.relays,
    )
    addresses = Addresses(
        [(one.network, one.address) for one in settings.advertise],
        base.lifeline.route_to if settings.isolation == "netns" else None,
        base.sockets[RVMASTER].getsockname()[0],
    )
    delivery = Delivery(
        timeout=settings.limits.node_call_seconds,
        limits=value_limits(settings),
        troubled=wires.node_troubled,
        standing=base.standing,
    )
    relay = RelayControl(
        registry,
        places,
        base.store,
        delivery,
        base.recorder,
        allocation=base.monitors.allocation,
        policy=lambda: base.policies.current,
        broken=wires.look_at,
    )
    mediation = Mediation(
        lambda: base.policies.current,
        lambda: base.monitors.checked,
        relay_all=settings.relaying == "all",
        stand_ins=settings.mediation == "full",
    )
    rights = ParameterRights(lambda: base.policies.current, base.recorder)
    graph = Graph(
        registry,
        relay,
        delivery,
        base.recorder,
        mediation,
        closed=wires.close_faces,
        may_be_told=rights.may_be_told,
    )
    return _Reach(registry, places, addresses, delivery, relay, mediation, graph, rights)


def _make_faces(base: Foundation, wires: _Wires, reach: _Reach) -> Faces:
    return Faces(
        reach.registry,
        reach.places,
        inner_port=base.port(INNER),
        serve=wires.serve,
        address_for=reach.addresses.told_to,
        limits=base.doors.http,
        visitors=base.doors.visitors,
        turns=base.doors.turns,
        refuse=base.doors.refuse,
        troubled=base.doors.troubled,
        revive=wires.revive,
        forget=reach.graph.forgotten,
    )


def _make_execution(
    base: Foundation, reach: _Reach, books: _Books, gate: Gate, parameters: ParameterCalls
) -> Execution:
    return Execution(
        gate=gate,
        policy=lambda: base.policies.current,
        recorder=base.recorder,
        registry=reach.registry,
        liveness=books.liveness,
        parameters=parameters,
        redecide_for=books.revocation.redecide_for,
        large=int(base.settings.limits.offload_bytes),
        standing=base.standing,
    )


def _finish(base: Foundation, wires: _Wires, reach: _Reach, books: _Books) -> Parts:
    """The parts on top: the calls, and what they are carried out with."""
    settings, registry, relay = base.settings, reach.registry, reach.relay
    mirror, liveness, port = books.mirror, books.liveness, base.port(RVMASTER)
    offload = int(settings.limits.offload_bytes)
    gate = Gate(
        lambda: base.policies.current,
        registry,
        HostLimits(settings.limits.nodes_per_host, settings.limits.topics_per_host),
    )
    registration = RegistrationCalls(
        books.rosmaster, registry, reach.graph, books.faces, relay, reach.mediation, gate, reach.rights
    )
    lookups = LookupCalls(
        books.rosmaster,
        registry,
        books.faces,
        relay,
        reach.mediation,
        reach.addresses,
        port,
        stop=lambda reason: base.lifeline.say(messages.ApplianceStopRequested(reason)),
        unseen=settings.publish_as if settings.hide_publisher else None,
    )
    parameters = ParameterCalls(books.rosmaster, mirror, reach.graph, reach.rights, offload)
    search = ParameterSearch(books.rosmaster, mirror, reach.rights)
    monitor_calls = MonitorCalls(base.monitors, registry, relay, books.rosmaster.port, port)
    node_calls = NodeCalls(registry, relay, reach.mediation, reach.addresses, liveness, gate, port)
    execution = _make_execution(base, reach, books, gate, parameters)
    pipeline = Pipeline(
        execution,
        Multicall(execution, parameters, base.recorder, offload=offload),
        addresses=reach.addresses,
        recorder=base.recorder,
        limits=value_limits(settings),
        offload=offload,
        bulk=bulk_turns(base.standing),
    )
    node_table = served(NODE_CALLS.values(), node_calls)
    wires.node_handler.fill(lambda incarnation: pipeline.handler(node_table, target=incarnation))
    publisher = OwnPublisher(
        registry,
        reach.graph,
        books.registrar,
        name=settings.publish_as,
        inner_port=base.port(INNER),
        wanted=lambda: _published(base),
        register=registration.register_publisher,
    )
    reminders = Reminders(registry, relay, reach.graph)
    _connect(base, reach, books, reminders, publisher)
    return Parts(
        registry=registry,
        recorder=base.recorder,
        monitors=base.monitors,
        places=reach.places,
        delivery=reach.delivery,
        relay=relay,
        revocation=books.revocation,
        mediation=reach.mediation,
        graph=reach.graph,
        rosmaster=books.rosmaster,
        faces=books.faces,
        parameters=mirror,
        liveness=liveness,
        reminders=reminders,
        reconciler=books.reconciler,
        publisher=publisher,
        monitor_calls=monitor_calls,
        table=master_table(registration, lookups, parameters, search, monitor_calls),
        pipeline=pipeline,
        inner=InnerFace(registry),
    )


def _connect(
    base: Foundation, reach: _Reach, books: _Books, reminders: Reminders, publisher: OwnPublisher
) -> None:
    """What policy, hosts and specifications call when they change."""
    relay, revocation = reach.relay, books.revocation
    base.monitors.connect(Moving(relay, reach.graph, reminders))
    relay.statement, relay.heard, relay.lost = (
        base.monitors.statement, base.monitors.received, base.monitors.relay_lost,
    )  # fmt: skip
    base.monitors.published = publisher.wake
    if base.settings.monitors_on_rosout:
        relay.own_header = rosout.header(standard_definitions())
        said = rosout.Rosout(
            base.settings.publish_as, relay.publish, lambda name: base.monitors.checked.monitors.get(name, "")
        )
        base.monitors.records.told = said.reported
    base.hosts.changed, base.hosts.expel = base.policies.hosts_changed, revocation.expel
    base.hosts.ports.machines = lambda: Counter(
        str(one.host) for one in reach.registry.all() if one.life is Life.LIVE and not one.own
    )

    in_force = base.policies.current

    def policy_changed(policy: Policy) -> int:
        nonlocal in_force
        before, in_force = in_force, policy
        reach.places.policy_changed(policy.ports)
        revoked = revocation.redecide()
        relay.policy_changed(before, policy)
        return revoked

    base.policies.changed = policy_changed


def _published(base: Foundation) -> dict[str, str]:
    """The topics that the appliance's own publisher has, and their types."""
    own = {rosout.TOPIC: rosout.TYPE} if base.settings.monitors_on_rosout else {}
    return own | base.monitors.checked.publications
