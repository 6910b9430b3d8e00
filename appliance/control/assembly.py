"""Makes the parts of RVMaster and connects them.

Each is made from those before it. What changes the graph returns what follows from it, and `Enactor` carries that
out, so that hardly any part calls one that is made after it. Those that do have a lambda here: the faces serve calls,
and what is relayed and published depends on the specifications, whose relays must be there to take them.
"""

import asyncio
import socket
from collections import Counter
from collections.abc import Mapping
from dataclasses import dataclass
from ipaddress import ip_address, ip_network

from appliance.channel import messages
from appliance.configuration.settings import Settings
from appliance.control.listener_limits import Doors, value_limits
from appliance.control.monitor_states import published_now
from appliance.control.policies import Policies
from appliance.control.quota_class import HostStanding
from appliance.control.recording_orders import RecordingOrders
from appliance.control.supervisor_link import ControlLifeline
from appliance.master import rosout
from appliance.master.calls.call import served
from appliance.master.calls.call_execution import Execution
from appliance.master.calls.call_table import MASTER_CALLS, master_table
from appliance.master.calls.gate import Gate, HostLimits
from appliance.master.calls.lookups import LookupCalls
from appliance.master.calls.monitor_calls import MonitorCalls
from appliance.master.calls.multicall import Multicall
from appliance.master.calls.node_calls import NODE_CALLS, NodeCalls
from appliance.master.calls.parameter_calls import ParameterCalls, ParameterSearch
from appliance.master.calls.parameter_rights import ParameterRights
from appliance.master.calls.pipeline import Pipeline
from appliance.master.calls.registration import RegistrationCalls
from appliance.master.endpoints.delivery import Delivery
from appliance.master.endpoints.endpoint_addresses import Addresses, Places
from appliance.master.endpoints.node_api import NodeApi
from appliance.master.endpoints.proxy_endpoints import Faces, InnerFace
from appliance.master.endpoints.relay_control import RelayControl
from appliance.master.endpoints.traffic import Carried
from appliance.master.graph.effects import Effects
from appliance.master.graph.grants import Grants
from appliance.master.graph.graph import Graph
from appliance.master.graph.mediation import Mediation
from appliance.master.graph.registry import Life, Registry
from appliance.master.graph.revocation import Revocation, revoked
from appliance.master.parameter_charges import ParameterCharges
from appliance.master.parameter_mirror import ParameterMirror
from appliance.master.reconcile.arrivals import Arrivals
from appliance.master.reconcile.enactor import Enactor
from appliance.master.reconcile.entries import Entries
from appliance.master.reconcile.liveness import Liveness, Watchlist
from appliance.master.reconcile.moves import Moving
from appliance.master.reconcile.publisher import OwnPublisher
from appliance.master.reconcile.reconciler import Reconciler
from appliance.master.reconcile.reminders import Reminders
from appliance.master.rosmaster import RosMaster, limits_of_answers, own_parameters
from appliance.policy.model import Address
from appliance.policy.policy import Policy
from appliance.quotas.pool import Pool
from appliance.quotas.table import PARAMETER_BYTES
from appliance.recorder.recording_plan import RecordingPlan
from appliance.rpc.bulk import LargeWrites, bulk_turns
from appliance.specifications.allocation import Allocation
from appliance.specifications.compiler_link import SpecificationCompiler
from appliance.specifications.specifications import ALLOCATION, Monitors
from appliance.store.state_file import StateStore
from appliance.telemetry.audit_trail import AuditTrail
from roswire import log_message

RVMASTER, INNER = "rvmaster", "inner"


@dataclass(frozen=True, slots=True)
class Foundation:
    """What is there before the parts: settings, durable state, policy, and the listeners.

    `parameters_dirty` is set when the mirror of the parameters has changed.
    """

    settings: Settings
    lifeline: ControlLifeline
    compiler: SpecificationCompiler
    store: StateStore
    trail: AuditTrail
    plan: RecordingPlan
    policies: Policies
    registry: Registry
    standing: HostStanding
    doors: Doors
    sockets: Mapping[str, socket.socket]
    parameters_dirty: asyncio.Event

    def port(self, name: str) -> int:
        """The port of a listener."""
        return int(self.sockets[name].getsockname()[1])


class Parts:
    """The parts of RVMaster; nothing serves yet. `table` is the Master API."""

    def __init__(self, base: Foundation) -> None:
        self._base = base
        self._limits = value_limits(base.settings)
        self._offload = int(base.settings.limits.offload_bytes)
        self.registry, self.trail = base.registry, base.trail
        self.recordings = RecordingOrders(
            base.settings.recorder,
            base.trail,
            lambda: messages.RevisionsStated(base.policies.revision, self.monitors.revision),
            base.plan,
        )
        self._make_graph()
        self._make_reach()
        self._make_changers()
        self._make_monitors()
        self._make_calls()

    def _make_graph(self) -> None:
        """What decides, and touches nothing."""
        base, settings = self._base, self._base.settings
        self._carried = Carried(self.trail, self.registry, settings.relays)
        self.grants = Grants(self._carried.used)
        self.mediation = Mediation(
            self._policy,
            lambda: self.monitors.checked,
            relay_all=settings.relaying == "all",
            stand_ins=settings.mediation == "full",
        )
        self._rights = ParameterRights(self._policy, self.trail)
        self.graph = Graph(self.registry, self.grants, self.mediation, may_be_told=self._rights.may_be_told)
        host_limits = HostLimits(settings.limits.nodes_per_host, settings.limits.topics_per_host)
        self._gate = Gate(self._policy, self.registry, host_limits)
        self.parameters = _make_mirror(base)
        self.revocation = Revocation(
            self.registry, self.grants, self.graph, self._policy, lambda: self.parameters.tree
        )

    def _make_reach(self) -> None:
        """What nodes, relays and ROSMaster are reached by, and what carries effects out to them."""
        base, settings, policies = self._base, self._base.settings, self._base.policies
        self.places = Places(
            settings.listen_address[0],
            policies.current.ports,
            keep=base.lifeline.keep,
            drop=base.lifeline.drop,
            named_as=lambda host: policies.current.named_as(host),  # noqa: PLW0108 - the one in force then
            relays=settings.relays,
        )
        self._addresses = Addresses(
            [(ip_network(each.network), ip_address(each.address)) for each in settings.advertise],
            base.lifeline.route_to if settings.isolation == "netns" else None,
            base.sockets[RVMASTER].getsockname()[0],
        )
        self._watchlist = Watchlist()
        seconds = settings.limits.node_call_seconds
        self._nodes = NodeApi(self.registry, timeout=seconds)
        self.delivery = Delivery(self._nodes, troubled=self._watchlist.could_not_tell, standing=base.standing)
        self._allocation = Allocation(settings.relays, lambda text: base.store.save_setting(ALLOCATION, text))
        self.relay = RelayControl(
            self.registry,
            self.grants,
            self.places,
            self._nodes,
            self._carried,
            allocation=self._allocation,
            policy=self._policy,
            monitors=lambda: self.monitors,
            broken=self._watchlist.look_at,
            own_header=_header_of_rosout() if settings.monitors_on_rosout else None,
            own_call=self.recordings.called,
        )
        self.rosmaster = RosMaster(
            settings.rosmaster_port,
            limits=limits_of_answers(self._limits, int(settings.limits.parameter_bytes)),
            small={call.name for call in MASTER_CALLS.values() if call.small},
        )
        self.faces = Faces(
            self.registry,
            self.places,
            inner_port=base.port(INNER),
            serve=lambda incarnation: self.pipeline.handler(self._node_table, target=incarnation),
            limits=base.doors.http,
            visitors=base.doors.visitors,
            turns=base.doors.turns,
            time=base.doors.time,
            refuse=base.doors.refuse,
            troubled=base.doors.troubled,
        )
        self.inner = InnerFace(self.registry)
        self._entries = Entries(self.rosmaster, self.faces.inner_uri)
        self.enactor = Enactor(
            self.graph,
            self._entries,
            store=base.store,
            trail=self.trail,
            delivery=self.delivery,
            relay=self.relay,
            faces=self.faces,
            places=self.places,
        )

    def _make_changers(self) -> None:
        """What changes the graph: by itself, and because a node asks for it."""
        settings = self._base.settings
        self.liveness = Liveness(
            self.registry,
            self.graph,
            self.revocation,
            self.enactor,
            self._watchlist,
            nodes=self._nodes,
            settings=settings.liveness,
            standing=self._base.standing,
        )
        self.reconciler = Reconciler(
            self.rosmaster,
            self._entries,
            self.registry,
            self.faces,
            self.graph,
            self.revocation,
            self.enactor,
            self.parameters,
            self.trail,
            own_parameters=own_parameters,
        )
        self.reminders = Reminders(self.registry, self.graph, self.enactor)
        arrivals = Arrivals(
            self.registry,
            self.graph,
            self.enactor,
            self.liveness,
            places=self.places,
            faces=self.faces,
            addresses=self._addresses,
        )
        self._registration = RegistrationCalls(
            self.rosmaster,
            self.registry,
            self.graph,
            self.enactor,
            self.faces,
            arrivals,
            self.relay,
            self.mediation,
            self._gate,
            self._rights,
        )

    def _make_monitors(self) -> None:
        """The specifications, and what is published in their name."""
        base, settings = self._base, self._base.settings
        told = rosout.Rosout(
            settings.publish_as, self.relay.publish, lambda name: self.monitors.checked.monitors.get(name, "")
        )
        self.publisher = OwnPublisher(
            self.registry,
            self.graph,
            self.enactor,
            self._entries,
            name=settings.publish_as,
            inner_port=base.port(INNER),
            wanted=self._published,
            services=settings.own_services,
            register=self._registration.register_publisher,
            offer=self._registration.register_service,
        )
        self.monitors = Monitors(
            settings.monitors,
            settings.enable,
            base.store,
            self.trail,
            on_fault=settings.on_fault,
            slices=settings.slices,
            allocation=self._allocation,
            relays=Moving(self.relay, self.graph, self.enactor, self.reminders),
            published=self.publisher.wake,
            told=[told.reported] if settings.monitors_on_rosout else [],
            site_keys=settings.site_keys,
            check=base.compiler.check,
            try_out=base.compiler.try_out,
            parts=base.compiler.parts,
            live=lambda: published_now(self.registry),
        )

    def _make_calls(self) -> None:
        """The calls, and what they are carried out with."""
        base, settings, port = self._base, self._base.settings, self._base.port(RVMASTER)
        lookups = LookupCalls(
            self.registry,
            self.graph,
            self.enactor,
            self.relay,
            self.mediation,
            self._addresses,
            port,
            stop=lambda reason: base.lifeline.say(messages.ApplianceStopRequested(reason)),
            unseen=settings.publish_as if settings.hide_publisher else None,
        )
        parameters = ParameterCalls(
            self.rosmaster, self.parameters, self.graph, self.enactor, self._rights, self._offload
        )
        search = ParameterSearch(self.rosmaster, self.parameters, self._rights)
        self.monitor_calls = MonitorCalls(self.monitors, self.registry, self.relay, self.rosmaster.port, port)
        node_calls = NodeCalls(
            self.registry,
            self.graph,
            self.enactor,
            self.relay,
            self.mediation,
            self._addresses,
            self._nodes,
            self.liveness,
            self._gate,
            port,
        )
        self.table = master_table(self._registration, lookups, parameters, search, self.monitor_calls)
        self._node_table = served(NODE_CALLS.values(), node_calls)
        execution = Execution(
            gate=self._gate,
            policy=self._policy,
            trail=self.trail,
            registry=self.registry,
            enactor=self.enactor,
            liveness=self.liveness,
            parameters=parameters,
            redecide_for=lambda host, name: self.enactor.carry_out(self.revocation.redecide_for(host, name)),
            large=self._offload,
            large_writes=LargeWrites(self._offload, base.standing),
        )
        self.pipeline = Pipeline(
            execution,
            Multicall(execution, parameters, self.trail, offload=self._offload),
            addresses=self._addresses,
            trail=self.trail,
            limits=self._limits,
            offload=self._offload,
            bulk=bulk_turns(base.standing),
            processor=base.doors.time,
        )

    def policy_changed(self, before: Policy, policy: Policy) -> int:
        """Another policy is in force: take back what it does not allow, and say how much that was."""
        return self._take_back(self.revocation.policy_changed(before, policy))

    def expel(self, host: Address, reason: str) -> int:
        """Take back all that a host has, and say how much that was."""
        return self._take_back(self.revocation.expel(host, reason))

    def machines(self) -> dict[str, int]:
        """The number of nodes by address."""
        return Counter(
            str(incarnation.host)
            for incarnation in self.registry.all()
            if incarnation.life is Life.LIVE and not incarnation.own
        )

    def _take_back(self, effects: Effects) -> int:
        self.enactor.carry_out(effects)
        return revoked(effects)

    def _policy(self) -> Policy:
        return self._base.policies.current

    def _published(self) -> dict[str, str]:
        """The topics that the appliance's own publisher has, and their types."""
        own = {rosout.TOPIC: log_message.TYPE} if self._base.settings.monitors_on_rosout else {}
        return own | self.monitors.checked.publications


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
        together=base.store.database.together,
        since=base.store.parameter_changes(),
    )


def _header_of_rosout() -> messages.OwnHeaderStated:
    from roswire.standard import standard_definitions  # noqa: PLC0415  only where it is configured

    return rosout.header(standard_definitions())
