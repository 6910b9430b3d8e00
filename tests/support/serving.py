from collections.abc import Callable
from typing import Any

from appliance.master.calls.call import served
from appliance.master.calls.call_execution import Execution
from appliance.master.calls.call_table import master_table
from appliance.master.calls.gate import CallGate, HostLimits
from appliance.master.calls.lookups import LookupCalls
from appliance.master.calls.monitor_calls import MonitorCalls
from appliance.master.calls.multicall import Multicall
from appliance.master.calls.node_calls import NODE_CALLS, NodeCalls
from appliance.master.calls.parameter_calls import ParameterCalls
from appliance.master.calls.pipeline import Pipeline
from appliance.master.calls.registration import RegistrationCalls
from appliance.master.graph.registry import Incarnation, Registry
from appliance.master.parameter_mirror import ParameterMirror
from appliance.policy.policy import Policy
from appliance.quotas.pool import QuotaClass
from appliance.rpc.fair_queue import LargeWrites, bulk_turns
from appliance.rpc.processor_time import ProcessorTime
from appliance.rpc.server import Handler
from roswire.xmlrpc import XmlRpcLimits


def serving(
    *,
    policy: Callable[[], Policy],
    registry: Registry,
    graph: Any,
    subscribers: Any,
    flush: Any,
    rosmaster: Any,
    mirror: ParameterMirror,
    trail: Any,
    rights: Any,
    addresses: Any,
    faces: Any = None,
    arrivals: Any = None,
    relay: Any = None,
    liveness: Any = None,
    nodes: Any = None,
    redecide_for: Any = None,
    offload: int = 1 << 20,
    own: bool = False,
    target: Incarnation | None = None,
) -> Handler:
    gate = CallGate(policy, registry, HostLimits())
    parameters = ParameterCalls(rosmaster, mirror, subscribers, rights, offload)
    execution = Execution(
        gate=gate,
        policy=policy,
        trail=trail,
        registry=registry,
        flush=flush,
        liveness=liveness,
        parameters=parameters,
        redecide_for=redecide_for,
        hold_call=lambda request: f"held: {request.resource}",
        large=offload,
        large_writes=LargeWrites(offload, lambda _host: QuotaClass.REGISTERED),
    )
    pipeline = Pipeline(
        execution,
        Multicall(execution, parameters, trail, offload=offload),
        addresses=addresses,
        trail=trail,
        limits=XmlRpcLimits(),
        offload=offload,
        bulk=bulk_turns(lambda _host: QuotaClass.REGISTERED),
        processor=ProcessorTime(lambda host: host),
    )
    monitors: Any = None
    if target is not None:
        node_calls = NodeCalls(registry, graph, relay, addresses, nodes, liveness, gate, 11311)
        return pipeline.handler(served(NODE_CALLS.values(), node_calls), target=target)
    return pipeline.handler(
        master_table(
            RegistrationCalls(registry, graph, arrivals, relay, parameters, subscribers),
            LookupCalls(
                registry,
                graph,
                relay,
                addresses,
                port=11311,
                stop=lambda _reason: None,
            ),
            parameters,
            MonitorCalls(monitors, registry, relay, real_port=11312, port=11311),
        ),
        own=own,
    )
