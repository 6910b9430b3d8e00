"""Make the endpoints of RVMaster, which carry changes of the graph to nodes, relays and the ROS master."""

from dataclasses import dataclass
from ipaddress import ip_address, ip_network

from appliance.channel import messages
from appliance.configuration.settings import Settings
from appliance.control.assembly.current import Current
from appliance.control.assembly.foundation import INNER, RVMASTER, Foundation
from appliance.control.assembly.listener_limits import value_limits
from appliance.control.assembly.master_core import MasterCore
from appliance.control.links.supervisor_link import ControlLifeline
from appliance.control.monitor_call_gate import MonitorCallGate, own_host
from appliance.master import rosout
from appliance.master.endpoints.delivery import Delivery, NodeApiClient
from appliance.master.endpoints.node_ports import AdvertisedAddresses, NodePorts
from appliance.master.endpoints.relay_control import RelayControl
from appliance.master.reconcile.liveness import Liveness
from appliance.master.reconcile.sinks import Enforcement, MasterSideApi, ProxyEndpoints, Sinks, StoredGraph
from appliance.master.reconcile.subscribers import Subscribers
from appliance.master.rosmaster import MasterRegistrations, RosMaster, limits_of_answers
from appliance.rpc.server import listen
from appliance.specifications.allocation import Allocation
from appliance.specifications.specification_manager import ALLOCATION
from roswire.standard import standard_definitions

_REFUSALS = 2
_REFUSALS_OF_A_ROBOT = (
    4  # a further computer whose cable was unplugged refuses until it admits this appliance again
)


@dataclass(frozen=True, slots=True)
class Endpoints:
    places: NodePorts
    addresses: AdvertisedAddresses
    relay: RelayControl
    rosmaster: RosMaster
    faces: ProxyEndpoints
    inner: MasterSideApi
    subscribers: Subscribers
    entries: MasterRegistrations
    sinks: Sinks
    enforcement: Enforcement
    liveness: Liveness


def make_endpoints(base: Foundation, core: MasterCore) -> Endpoints:
    places = _make_node_ports(base.settings, base.lifeline, core)
    nodes = NodeApiClient(core.registry, timeout=base.settings.limits.node_call_seconds)
    delivery = Delivery(nodes, troubled=core.watchlist.could_not_tell, quota_class=base.quota_class)
    gate = Current[MonitorCallGate]()
    relay = _make_relay(base, core, places, nodes, gate)
    rosmaster = _make_rosmaster(base.settings)
    faces = ProxyEndpoints(
        core.registry, places, inner_port=base.port(INNER), server=base.listener_limits.server
    )
    entries = MasterRegistrations(rosmaster, core.registry, faces.inner_uri)
    subscribers = _make_subscribers(core, relay, delivery)
    stored = StoredGraph(core.grants, base.store)
    sinks = Sinks(core.registry, (stored, subscribers, entries, relay, faces))
    gate.set(_make_call_gate(base, core, relay, sinks))
    enforcement = Enforcement(core.revocation, sinks.flush, relay, places)
    base.enforcement.set(enforcement)
    return Endpoints(
        places=places,
        addresses=_make_addresses(base),
        relay=relay,
        rosmaster=rosmaster,
        faces=faces,
        inner=MasterSideApi(core.registry),
        subscribers=subscribers,
        entries=entries,
        sinks=sinks,
        enforcement=enforcement,
        liveness=_make_liveness(base, core, subscribers, nodes),
    )


def _make_node_ports(settings: Settings, lifeline: ControlLifeline, core: MasterCore) -> NodePorts:
    return NodePorts(
        settings.listen_address[0],
        range(0),  # those of the policy, once it is in force
        keep=lifeline.keep,
        drop=lifeline.drop,
        policy=core.policy,
        relays=settings.relays,
        listen=listen,
    )


def _make_rosmaster(settings: Settings) -> RosMaster:
    limits = limits_of_answers(value_limits(settings), int(settings.limits.parameter_bytes))
    return RosMaster(settings.rosmaster_port, limits=limits)


def _make_subscribers(core: MasterCore, relay: RelayControl, delivery: Delivery) -> Subscribers:
    return Subscribers(
        core.registry,
        core.grants,
        relay,
        delivery,
        lambda: core.parameters.tree,
        may_read_value=core.rights.may_read_value,
        may_know_value=core.rights.may_know_value,
    )


def _make_call_gate(base: Foundation, core: MasterCore, relay: RelayControl, sinks: Sinks) -> MonitorCallGate:
    return MonitorCallGate(
        core.registry,
        core.graph,
        sinks.flush,
        core.policy,
        base.trail,
        relay,
        base.settings.publish_as,
        own_host(base.sockets[RVMASTER].getsockname()[0]),
    )


def _make_addresses(base: Foundation) -> AdvertisedAddresses:
    settings = base.settings
    return AdvertisedAddresses(
        [(ip_network(each.network), ip_address(each.address)) for each in settings.advertise],
        base.lifeline.questions.route_to if settings.isolation == "netns" else None,
        base.sockets[RVMASTER].getsockname()[0],
        fixed=base.role.address,
        tunnels=settings.ipsec.pool,
    )


def _make_liveness(
    base: Foundation, core: MasterCore, subscribers: Subscribers, nodes: NodeApiClient
) -> Liveness:
    return Liveness(
        core.registry,
        core.graph,
        core.revocation,
        subscribers,
        core.watchlist,
        nodes=nodes,
        settings=base.settings.liveness,
        quota_class=base.quota_class,
        refusals=_REFUSALS_OF_A_ROBOT if base.role.paired else _REFUSALS,
        shut_out=base.role.in_doubt,
        connects=core.carried.connects,
    )


def _make_relay(
    base: Foundation,
    core: MasterCore,
    places: NodePorts,
    nodes: NodeApiClient,
    gate: Current[MonitorCallGate],
) -> RelayControl:
    settings = base.settings
    return RelayControl(
        core.registry,
        core.grants,
        places.descriptor,
        nodes,
        core.carried,
        allocation=Allocation(settings.relays, lambda text: base.store.save_setting(ALLOCATION, text)),
        policy=core.policy,
        monitors=core.monitors,
        broken=core.watchlist.look_at,
        own_topics={rosout.TOPIC: _header_of_rosout()} if settings.monitors_on_rosout else {},
        own_call=lambda asked: (
            gate().answer(asked)
            if isinstance(asked, messages.MonitorCallWanted)
            else base.own_services.called(asked)
            if isinstance(asked, messages.OwnServiceCalled)
            else base.calls.request(asked)
        ),
        relay_all=settings.relaying == "all",
        stand_ins=settings.mediation == "full",
    )


def _header_of_rosout() -> messages.OwnHeaderStated:
    return rosout.header(standard_definitions())
