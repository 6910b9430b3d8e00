"""Assemble RVMaster from its core, its endpoints, the specifications and the calls."""

from dataclasses import dataclass
from functools import partial

from appliance.channel import messages
from appliance.control.assembly.endpoints import Endpoints, make_endpoints
from appliance.control.assembly.foundation import INNER, RVMASTER, Foundation
from appliance.control.assembly.listener_limits import value_limits
from appliance.control.assembly.master_core import MasterCore, make_master_core
from appliance.control.assembly.monitor_states import published_now
from appliance.master import rosout
from appliance.master.calls.arrivals import Arrivals, ServeNode
from appliance.master.calls.call import Table, served
from appliance.master.calls.call_execution import Execution
from appliance.master.calls.call_table import master_table
from appliance.master.calls.lookups import LookupCalls
from appliance.master.calls.monitor_calls import MonitorCalls
from appliance.master.calls.multicall import Multicall
from appliance.master.calls.node_calls import NODE_CALLS, NodeCalls
from appliance.master.calls.parameter_calls import ParameterCalls
from appliance.master.calls.pipeline import Pipeline
from appliance.master.calls.publisher import OwnPublisher
from appliance.master.calls.registration import RegistrationCalls
from appliance.master.reconcile.reconciler import Reconciler
from appliance.master.reconcile.reminders import RelayMoves, Reminders
from appliance.master.rosmaster import own_parameters
from appliance.rpc.fair_queue import LargeWrites, bulk_turns
from appliance.specifications.specification_manager import SpecificationManager


@dataclass(frozen=True, slots=True)
class Parts:
    """The parts of RVMaster. `table` is the Master API."""

    core: MasterCore
    endpoints: Endpoints
    reconciler: Reconciler
    reminders: Reminders
    publisher: OwnPublisher
    monitors: SpecificationManager
    monitor_calls: MonitorCalls
    pipeline: Pipeline
    table: Table
    serve: ServeNode


def assemble(base: Foundation) -> Parts:
    core = make_master_core(base)
    ends = make_endpoints(base, core)
    settings = base.settings
    reminders = Reminders(core.registry, ends.subscribers)
    base.role.on_end_of_gap(reminders.begin)
    parameters = ParameterCalls(
        ends.rosmaster,
        core.parameters,
        ends.subscribers,
        core.rights,
        int(base.settings.limits.offload_bytes),
    )
    pipeline = _make_pipeline(base, core, ends, parameters)
    node_calls = NodeCalls(
        core.registry,
        core.graph,
        ends.relay,
        ends.addresses,
        ends.relay.nodes,
        ends.liveness,
        core.gate,
        base.port(RVMASTER),
    )
    serve = partial(pipeline.handler, served(NODE_CALLS.values(), node_calls))
    arrivals = Arrivals(
        core.registry,
        core.graph,
        ends.sinks.flush,
        ends.liveness,
        places=ends.places,
        faces=ends.faces,
        addresses=ends.addresses,
        serve=serve,
    )
    registration = RegistrationCalls(
        core.registry, core.graph, arrivals, ends.relay, parameters, ends.subscribers
    )
    publisher = OwnPublisher(
        core.registry,
        core.graph,
        registration,
        name=settings.publish_as,
        inner_port=base.port(INNER),
        wanted=lambda: (
            {topic: header.type for topic, header in ends.relay.own_topics.items()}
            | core.monitors().checked.publications
        ),
        services=settings.own_services,
    )
    monitors = _make_monitors(base, core, ends, publisher, reminders)
    core.monitors.set(monitors)
    port = base.port(RVMASTER)
    monitor_calls = MonitorCalls(monitors, core.registry, ends.relay, ends.rosmaster.port, port)
    lookups = LookupCalls(
        core.registry,
        core.graph,
        ends.relay,
        ends.addresses,
        port,
        stop=lambda reason: base.lifeline.say(messages.ApplianceStopRequested(reason)),
        unseen=settings.publish_as if settings.hide_publisher else None,
    )
    return Parts(
        core=core,
        endpoints=ends,
        reconciler=Reconciler(
            ends.rosmaster,
            ends.entries,
            core.registry,
            ends.subscribers,
            core.parameters,
            base.trail,
            own_parameters=own_parameters,
        ),
        reminders=reminders,
        publisher=publisher,
        monitors=monitors,
        monitor_calls=monitor_calls,
        pipeline=pipeline,
        table=master_table(registration, lookups, parameters, monitor_calls),
        serve=serve,
    )


def _make_monitors(
    base: Foundation, core: MasterCore, ends: Endpoints, publisher: OwnPublisher, reminders: Reminders
) -> SpecificationManager:
    settings, compiler = base.settings, base.compiler
    log = rosout.Rosout(
        settings.publish_as,
        ends.relay.publish,
        lambda name: core.monitors().checked.monitors.get(name, ""),
    )
    return SpecificationManager(
        settings.monitors,
        settings.enable,
        base.store,
        base.ends,
        base.trail,
        on_fault=settings.on_fault,
        slices=settings.slices,
        allocation=ends.relay.allocation,
        relays=RelayMoves(ends.relay, ends.subscribers, reminders),
        published=publisher.wake,
        told=[log.reported] if settings.monitors_on_rosout else [],
        site_keys=settings.site_keys,
        check=compiler.check,
        check_at_start=compiler.check_at_start,
        try_out=compiler.try_out,
        parts=compiler.parts,
        live=lambda: published_now(core.registry, core.carried),
    )


def _make_pipeline(
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
