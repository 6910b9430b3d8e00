"""Make the core that features use from the parts of control."""

from functools import partial

from appliance.control.assembly.assembly import Parts
from appliance.control.assembly.foundation import RVMASTER, Foundation
from appliance.control.assembly.registrar import Registrar
from appliance.control.assembly.robot import charged_to
from appliance.control.core import (
    Alarms,
    Bearers,
    Core,
    GraphFacts,
    Links,
    OwnServices,
    PolicyFacts,
    RelayOrders,
    ResourceUses,
    RestServices,
)
from appliance.control.operators.limit_use import OwnUses
from appliance.control.operators.node_connections import NodeConnections
from appliance.control.operators.queries import graph_of, hosts_connected
from appliance.master.calls.parameter_calls import ParameterCalls
from appliance.master.endpoints.host_signs import host_signs
from appliance.policy.model import Address
from appliance.rpc.server import Peer
from roswire.xmlrpc import MethodCall, Value


def make_core(base: Foundation, parts: Parts, bearers: Bearers, alarms: Alarms) -> Core:
    return Core(
        settings=base.settings,
        role=base.role,
        trail=base.trail,
        store=base.store,
        ends=base.ends,
        links=Links(base.lifeline, base.receipts.received),
        policy=PolicyFacts(
            base.policies, base.policy_services, lambda host: charged_to(base.policies.current, host)
        ),
        specifications=parts.monitors,
        hosts=base.hosts,
        graph=_graph_facts(base, parts),
        relay=RelayOrders(parts.endpoints.relay, base.calls, parts.publisher.wake),
        rest=RestServices(),
        own_services=OwnServices(base.own_services),
        bearers=bearers,
        limits=ResourceUses(
            OwnUses(
                parts.core.registry,
                parts.core.carried,
                lambda: parts.endpoints.places.taken,
                base.listener_limits.connection_table.connected,
                parts.core.parameters.charges.pool,
                base.settings,
            )
        ),
        alarms=alarms,
    )


def _graph_facts(base: Foundation, parts: Parts) -> GraphFacts:
    registry, ends = parts.core.registry, parts.endpoints

    def host_of(node: str) -> Address | None:
        return None if (holder := registry.holder(node)) is None else holder.host

    def name_of(key: str) -> str:
        return "" if (node := registry.by_key(key)) is None else node.name

    return GraphFacts(
        present=partial(graph_of, registry, ends.relay),
        host_of=host_of,
        name_of=name_of,
        machines=registry.machines,
        connected=partial(hosts_connected, registry, parts.core.carried),
        live_rights=parts.core.revocation.live,
        expel=ends.enforcement.expel,
        signs=host_signs(registry, parts.core.carried),
        master_port=base.port(RVMASTER),
        connections=NodeConnections(registry, ends.subscribers.delivery, base.lifeline.surroundings),
        registrar=_registrar(parts),
    )


def _registrar(parts: Parts) -> Registrar:
    subscribers = parts.endpoints.subscribers
    parameters = parts.table["setParam"].part
    assert isinstance(parameters, ParameterCalls)  # noqa: S101  the table says so

    async def call(host: Address, local: str, method: str, values: tuple[Value, ...]) -> Value:
        peer = Peer(host, str(host), local)
        return await parts.pipeline.ordered(parts.table, peer, MethodCall(method, values))

    def silence() -> None:
        parts.reminders.close()
        subscribers.delivery.silence()

    def speak() -> None:
        subscribers.delivery.speak()
        subscribers.remind_all()

    return Registrar(
        registry=parts.core.registry,
        graph=parts.core.graph,
        subscribers=subscribers,
        parameters=parameters,
        flush=parts.endpoints.sinks.flush,
        call=call,
        ready=parts.reconciler.ready.wait,
        silence=silence,
        speak=speak,
    )
