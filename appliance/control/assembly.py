"""Makes the parts of RVMaster and connects them.

Parts need each other in circles (who delivers calls to nodes reports the dead ones to who looks after the living, and
that one delivers calls). Each builder makes some parts from those before it; what a part calls of a later one goes
through `Wires`, the one place where the circles are.
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
from appliance.master.calls.gate import Gate, HostLimits
from appliance.master.calls.parameter_charges import ParameterCharges
from appliance.master.calls.parameters import ParameterMirror, may_be_told
from appliance.master.calls.pipeline import Pipeline
from appliance.master.calls.registration import withdraw_lost
from appliance.master.core import Master
from appliance.master.graph.delivery import Delivery, NodeCall
from appliance.master.graph.graph import Graph
from appliance.master.graph.liveness import Liveness, LivenessSettings
from appliance.master.graph.publisher import OwnPublisher
from appliance.master.graph.reconcile import Reconciler
from appliance.master.graph.registry import Incarnation, Kind, Life, Registration, Registry
from appliance.master.graph.reminders import Reminders
from appliance.master.graph.revocation import Revocation
from appliance.master.later import Later
from appliance.master.policies import Policies
from appliance.master.reach.addresses import Addresses
from appliance.master.reach.faces import Faces
from appliance.master.reach.inner import InnerFace
from appliance.master.reach.mediation import Mediation
from appliance.master.reach.moving import Moving
from appliance.master.reach.node_calls import NODE_CALLS
from appliance.master.reach.places import Places
from appliance.master.reach.relays import RelayControl
from appliance.master.roscore import own_parameters
from appliance.master.rosmaster import RosMaster, limits_of_answers
from appliance.master.standing import HostStanding
from appliance.policy import Policy
from appliance.policy.model import Address
from appliance.recorder import Recorder
from appliance.ros.standard import standard_definitions
from appliance.ros.xmlrpc import Value
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
class Parts:
    """The parts that control itself starts, restores and ends; `master` has what a call is performed with."""

    master: Master
    revocation: Revocation
    places: Places
    delivery: Delivery
    reminders: Reminders
    reconciler: Reconciler
    publisher: OwnPublisher
    pipeline: Pipeline
    inner: InnerFace


@dataclass(frozen=True, slots=True)
class _Reach:
    """How nodes are known, found, told and carried."""

    registry: Registry
    places: Places
    addresses: Addresses
    delivery: Delivery
    relay: RelayControl
    mediation: Mediation
    graph: Graph


class _Wires:
    """What earlier parts call of later ones."""

    def __init__(self) -> None:
        self.liveness: Later[Liveness] = Later("liveness")
        self.faces: Later[Faces] = Later("faces")
        self.reconciler: Later[Reconciler] = Later("the reconcile loop")
        self.pipeline: Later[Pipeline] = Later("the pipeline")
        self.master: Later[Master] = Later("the master")
        self.revocation: Later[Revocation] = Later("the revocation")

    def node_troubled(self, incarnation: Incarnation, call: NodeCall, why: str) -> None:
        _log.info("a node could not be told", node=incarnation.name, call=call.method, why=why)
        self.liveness().missed(incarnation, call)

    def look_at(self, incarnation: Incarnation) -> None:
        self.liveness().look_at(incarnation)

    def close_faces(self, incarnation: Incarnation) -> None:
        self.faces().close(incarnation)

    async def revive(self, incarnation: Incarnation) -> None:
        await self.liveness().revive(incarnation)

    def returned(self, incarnation: Incarnation) -> None:
        self.revocation().returned(incarnation)

    def redecide_for(self, host: Address, caller_id: str) -> int:
        return self.revocation().redecide_for(host, caller_id)

    def may_have(self, incarnation: Incarnation, kind: Kind, resource: str) -> bool:
        return self.revocation().may_have(incarnation, kind, resource)

    def may_be_told(self, incarnation: Incarnation, key: str, value: Value) -> bool:
        return may_be_told(self.master(), incarnation, key, value)

    def rosmaster_lost(self) -> None:
        self.master().rosmaster.shut()
        self.reconciler().wake()

    async def withdraw(self, incarnation: Incarnation, registrations: list[Registration]) -> None:
        await withdraw_lost(self.master(), incarnation, registrations)

    def node_handler(self, incarnation: Incarnation) -> Handler:
        return self.pipeline().handler(NODE_CALLS, target=incarnation)


def assemble(base: Foundation) -> Parts:
    """All parts, connected; nothing serves yet."""
    wires = _Wires()
    reach = _make_reach(base, wires)
    faces = wires.faces.fill(_make_faces(base, wires, reach))
    rosmaster = RosMaster(
        base.settings.rosmaster_port,
        lost=wires.rosmaster_lost,
        limits=limits_of_answers(value_limits(base.settings), int(base.settings.limits.parameter_bytes)),
    )
    parameters = ParameterMirror(
        base.store.load_parameters(),
        base.parameters_dirty.set,
        _make_charges(base),
        depth_limit=base.settings.limits.nesting,
        note=base.store.note_parameter,
        since=base.store.parameter_changes(),
    )
    reconciler = wires.reconciler.fill(
        Reconciler(
            rosmaster,
            reach.registry,
            faces,
            reach.graph,
            parameters,
            base.recorder,
            own_parameters=own_parameters,
            may_have=wires.may_have,
        )
    )
    wires.liveness.fill(_make_liveness(base, wires, reach, reconciler))
    master = wires.master.fill(_make_master(base, wires, reach, rosmaster, parameters))
    return _finish(base, wires, reach, master)


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
    graph = Graph(
        registry,
        relay,
        delivery,
        base.recorder,
        mediation,
        closed=wires.close_faces,
        may_be_told=wires.may_be_told,
    )
    return _Reach(registry, places, addresses, delivery, relay, mediation, graph)


def _make_faces(base: Foundation, wires: _Wires, reach: _Reach) -> Faces:
    return Faces(
        reach.registry,
        reach.places,
        inner_port=base.port(INNER),
        serve=wires.node_handler,
        address_for=reach.addresses.told_to,
        limits=base.doors.http,
        visitors=base.doors.visitors,
        turns=base.doors.turns,
        refuse=base.doors.refuse,
        troubled=base.doors.troubled,
        revive=wires.revive,
        forget=reach.graph.forgotten,
    )


def _make_liveness(base: Foundation, wires: _Wires, reach: _Reach, reconciler: Reconciler) -> Liveness:
    settings = base.settings
    return Liveness(
        reach.registry,
        reach.graph,
        LivenessSettings(
            settings.liveness.interval,
            settings.liveness.silent,
            settings.liveness.shadow,
            settings.limits.node_call_seconds,
        ),
        value_limits(settings),
        withdraw=wires.withdraw,
        put_back=reconciler.put_back,
        returned=wires.returned,
        standing=base.standing,
    )


def _make_master(
    base: Foundation, wires: _Wires, reach: _Reach, rosmaster: RosMaster, parameters: ParameterMirror
) -> Master:
    settings = base.settings
    gate = Gate(
        lambda: base.policies.current,
        reach.registry,
        HostLimits(settings.limits.nodes_per_host, settings.limits.topics_per_host),
    )
    return Master(
        port=base.port(RVMASTER),
        registry=reach.registry,
        gate=gate,
        recorder=base.recorder,
        rosmaster=rosmaster,
        relay=reach.relay,
        graph=reach.graph,
        faces=wires.faces(),
        liveness=wires.liveness(),
        parameters=parameters,
        mediation=reach.mediation,
        monitors=base.monitors,
        publish_as=settings.publish_as,
        hide_publisher=settings.hide_publisher,
        addresses=reach.addresses,
        policy=lambda: base.policies.current,
        stop=lambda reason: base.lifeline.say(messages.ApplianceStopRequested(reason)),
        redecide_for=wires.redecide_for,
    )


def _finish(base: Foundation, wires: _Wires, reach: _Reach, master: Master) -> Parts:
    """The parts on top, and what policy, hosts and specifications call when they change."""
    relay, reminders = reach.relay, Reminders(reach.registry, reach.relay, reach.graph)
    base.monitors.connect(Moving(relay, reach.graph, reminders))
    relay.statement, relay.heard, relay.lost = (
        base.monitors.statement, base.monitors.received, base.monitors.relay_lost,
    )  # fmt: skip
    publisher = OwnPublisher(master, base.settings.publish_as, base.port(INNER), lambda: _published(base))
    base.monitors.published = publisher.wake
    if base.settings.monitors_on_rosout:
        relay.own_header = rosout.header(standard_definitions())
        said = rosout.Rosout(
            base.settings.publish_as, relay.publish, lambda name: base.monitors.checked.monitors.get(name, "")
        )
        base.monitors.records.told = said.reported
    reconciler = wires.reconciler()
    revocation = wires.revocation.fill(Revocation(master, put_back=reconciler.put_back))
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
    return Parts(
        master=master,
        revocation=revocation,
        places=reach.places,
        delivery=reach.delivery,
        reminders=reminders,
        reconciler=reconciler,
        publisher=publisher,
        pipeline=wires.pipeline.fill(
            Pipeline(
                master,
                limits=value_limits(base.settings),
                offload=int(base.settings.limits.offload_bytes),
                standing=base.standing,
            )
        ),
        inner=InnerFace(reach.registry),
    )


def _published(base: Foundation) -> dict[str, str]:
    """The topics that the appliance's own publisher has, and their types."""
    own = {rosout.TOPIC: rosout.TYPE} if base.settings.monitors_on_rosout else {}
    return own | base.monitors.checked.publications
