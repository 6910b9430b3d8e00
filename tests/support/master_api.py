from collections.abc import Callable
from dataclasses import dataclass
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
from appliance.policy.model import CallHold
from appliance.policy.policy import Policy
from appliance.quotas.pool import QuotaClass
from appliance.rpc.fair_queue import LargeWrites, bulk_turns
from appliance.rpc.processor_time import ProcessorTime
from appliance.rpc.server import Handler
from roswire.xmlrpc import XmlRpcLimits


@dataclass(frozen=True, kw_only=True)
class MasterApi:
    """The calls of RVMaster on these parts: from a request to its answer."""

    policy: Callable[[], Policy]
    registry: Registry
    graph: Any
    subscribers: Any
    flush: Any
    rosmaster: Any
    mirror: ParameterMirror
    trail: Any
    rights: Any
    addresses: Any
    arrivals: Any = None
    relay: Any = None
    liveness: Any = None
    nodes: Any = None
    redecide_for: Any = None
    offload: int = 1 << 20

    def handler(self, *, own: bool = False, target: Incarnation | None = None) -> Handler:
        """Return the handler of RVMaster, of its listener for our own node, or of the node `target`."""
        gate = CallGate(self.policy, self.registry, HostLimits())
        parameters = ParameterCalls(
            self.rosmaster, self.mirror, self.subscribers.parameter_set, self.rights, self.offload
        )
        pipeline = self._pipeline(gate, parameters)
        if target is not None:
            parts = (self.registry, self.graph, self.relay, self.addresses, self.nodes, self.liveness)
            return pipeline.handler(
                served(NODE_CALLS.values(), NodeCalls(*parts, gate, 11311)), target=target
            )
        registry, graph, relay = self.registry, self.graph, self.relay
        monitors: Any = None
        table = master_table(
            RegistrationCalls(registry, graph, self.arrivals, relay, parameters, self.subscribers),
            LookupCalls(registry, graph, relay, self.addresses, port=11311, stop=lambda _reason: None),
            parameters,
            MonitorCalls(monitors, registry, relay, real_port=11312, port=11311),
        )
        return pipeline.handler(table, own=own)

    def _pipeline(self, gate: CallGate, parameters: ParameterCalls) -> Pipeline:
        execution = Execution(
            gate=gate,
            policy=self.policy,
            trail=self.trail,
            registry=self.registry,
            flush=self.flush,
            liveness=self.liveness,
            parameters=parameters,
            redecide_for=self.redecide_for,
            hold_call=lambda request: CallHold(f"held: {request.resource}", waits=True),
            large=self.offload,
            large_writes=LargeWrites(self.offload, lambda _host: QuotaClass.REGISTERED),
        )
        return Pipeline(
            execution,
            Multicall(execution, parameters, self.trail, offload=self.offload),
            addresses=self.addresses,
            trail=self.trail,
            limits=XmlRpcLimits(),
            offload=self.offload,
            bulk=bulk_turns(lambda _host: QuotaClass.REGISTERED),
            processor=ProcessorTime(lambda host: host),
        )
