"""Assemble RVMaster from its core, its endpoints, the specifications and the calls."""

from dataclasses import dataclass
from functools import partial

from appliance.configuration.settings import Settings
from appliance.control.assembly.endpoints import Endpoints, make_endpoints
from appliance.control.assembly.foundation import INNER, RVMASTER, Foundation
from appliance.control.assembly.master_calls import (
    make_arrivals,
    make_lookups,
    make_node_calls,
    make_pipeline,
)
from appliance.control.assembly.master_core import MasterCore, make_master_core
from appliance.control.assembly.monitor_states import published_now
from appliance.master import rosout
from appliance.master.calls.call import Table, served
from appliance.master.calls.call_table import master_table
from appliance.master.calls.monitor_calls import MonitorCalls
from appliance.master.calls.node_calls import NODE_CALLS
from appliance.master.calls.parameter_calls import ParameterCalls
from appliance.master.calls.pipeline import Pipeline
from appliance.master.calls.publisher import OwnPublisher
from appliance.master.calls.registration import RegistrationCalls, ServeNode
from appliance.master.reconcile.reconciler import Reconciler
from appliance.master.reconcile.reminders import RelayMoves, Reminders
from appliance.master.rosmaster import own_parameters
from appliance.specifications.specification_manager import SpecificationManager
from appliance.telemetry.audit_trail import AuditTrail


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
    reminders = Reminders(core.registry, ends.subscribers.absent, ends.subscribers.renew)
    base.role.on_end_of_gap(reminders.begin)
    parameters = ParameterCalls(
        ends.rosmaster,
        core.parameters,
        ends.subscribers.parameter_set,
        core.rights,
        int(base.settings.limits.offload_bytes),
    )
    pipeline = make_pipeline(base, core, ends, parameters)
    port = base.port(RVMASTER)
    serve = partial(pipeline.handler, served(NODE_CALLS.values(), make_node_calls(core, ends, port)))
    arrivals = make_arrivals(core, ends, serve)
    registration = RegistrationCalls(
        core.registry, core.graph, arrivals, ends.relay, parameters, ends.subscribers
    )
    publisher = _make_publisher(base.settings, base.port(INNER), core, ends, registration)
    monitors = _make_monitors(base, core, ends, publisher, reminders)
    core.monitors.set(monitors)
    monitor_calls = MonitorCalls(monitors, core.registry, ends.relay, ends.rosmaster.port, port)
    lookups = make_lookups(base.settings, base.lifeline, port, core, ends)
    return Parts(
        core=core,
        endpoints=ends,
        reconciler=_make_reconciler(core, ends, base.trail),
        reminders=reminders,
        publisher=publisher,
        monitors=monitors,
        monitor_calls=monitor_calls,
        pipeline=pipeline,
        table=master_table(registration, lookups, parameters, monitor_calls),
        serve=serve,
    )


def _make_publisher(
    settings: Settings, inner_port: int, core: MasterCore, ends: Endpoints, registration: RegistrationCalls
) -> OwnPublisher:
    return OwnPublisher(
        core.registry,
        core.graph,
        registration,
        name=settings.publish_as,
        inner_port=inner_port,
        wanted=lambda: (
            {topic: header.type for topic, header in ends.relay.own_topics.items()}
            | core.monitors().checked.publications
        ),
        services=settings.own_services,
    )


def _make_reconciler(core: MasterCore, ends: Endpoints, trail: AuditTrail) -> Reconciler:
    return Reconciler(
        ends.rosmaster,
        ends.entries,
        core.registry,
        ends.subscribers,
        core.parameters,
        trail,
        own_parameters=own_parameters,
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
