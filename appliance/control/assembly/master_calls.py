"""Make the calls of RVMaster: their way from a host to an answer, and the parts that carry them out."""

from appliance.channel import messages
from appliance.configuration.settings import Settings
from appliance.control.assembly.endpoints import Endpoints
from appliance.control.assembly.foundation import Foundation
from appliance.control.assembly.listener_limits import value_limits
from appliance.control.assembly.master_core import MasterCore
from appliance.control.links.supervisor_link import ControlLifeline
from appliance.master.calls.call_execution import Execution
from appliance.master.calls.lookups import LookupCalls
from appliance.master.calls.multicall import Multicall
from appliance.master.calls.node_calls import NodeCalls
from appliance.master.calls.parameter_calls import ParameterCalls
from appliance.master.calls.pipeline import Pipeline
from appliance.master.calls.registration import Arrivals, ServeNode
from appliance.rpc.fair_queue import LargeWrites, bulk_turns


def make_pipeline(
    base: Foundation, core: MasterCore, ends: Endpoints, parameters: ParameterCalls
) -> Pipeline:
    settings, trail, offload = base.settings, base.trail, int(base.settings.limits.offload_bytes)
    execution = Execution(
        gate=core.gate,
        policy=core.policy,
        trail=trail,
        registry=core.registry,
        flush=ends.sinks.flush,
        liveness=ends.liveness,
        parameters=parameters,
        redecide_for=ends.enforcement.redecide_for,
        hold_call=base.calls.call,
        large=offload,
        large_writes=LargeWrites(offload, base.quota_class, base.role.before_answer),
    )
    return Pipeline(
        execution,
        Multicall(execution, parameters, trail, offload=offload),
        addresses=ends.addresses,
        trail=trail,
        limits=value_limits(settings),
        offload=offload,
        bulk=bulk_turns(base.quota_class),
        processor=base.listener_limits.time,
        before_answer=base.role.before_answer,
    )


def make_node_calls(core: MasterCore, ends: Endpoints, port: int) -> NodeCalls:
    return NodeCalls(
        core.registry,
        core.graph,
        ends.relay,
        ends.addresses,
        ends.relay.nodes,
        ends.liveness,
        core.gate,
        port,
    )


def make_arrivals(core: MasterCore, ends: Endpoints, serve: ServeNode) -> Arrivals:
    return Arrivals(
        core.registry,
        core.graph,
        ends.sinks.flush,
        ends.liveness,
        places=ends.places,
        faces=ends.faces,
        addresses=ends.addresses,
        serve=serve,
    )


def make_lookups(
    settings: Settings, lifeline: ControlLifeline, port: int, core: MasterCore, ends: Endpoints
) -> LookupCalls:
    return LookupCalls(
        core.registry,
        core.graph,
        ends.relay,
        ends.addresses,
        port,
        stop=lambda reason: lifeline.say(messages.ApplianceStopRequested(reason)),
        unseen=settings.publish_as if settings.hide_publisher else None,
    )
