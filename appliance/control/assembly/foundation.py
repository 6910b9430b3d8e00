"""Make the first part of control: the store, the audit log, the policy, the tunnels and the listening sockets."""

import asyncio
import socket
from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from typing import NamedTuple

import structlog

from appliance.audit.log.log import AuditLog
from appliance.configuration.settings import Settings
from appliance.control.assembly.active_role import ActiveRole
from appliance.control.assembly.current import Current
from appliance.control.assembly.host_authority import make_host_table
from appliance.control.assembly.host_blocks import BlockTable
from appliance.control.assembly.hosts import SiteHosts
from appliance.control.assembly.listener_limits import HostQuotaClass, ListenerLimits
from appliance.control.assembly.open_audit import open_audit
from appliance.control.assembly.policies import Policies, passed_changes
from appliance.control.assembly.robot import robot_addresses
from appliance.control.assembly.services import CallHolder, OwnServiceTable, PolicyServices
from appliance.control.links.signer_requests import ReceiptFloor, SignerRequests
from appliance.control.links.supervisor_link import ControlLifeline
from appliance.hosts.tunnel_state import Tunnels
from appliance.master.graph.registry import Registry
from appliance.master.reconcile.sinks import Enforcement
from appliance.policy.judgement import IN_CONTROL, PolicyContext
from appliance.policy.policy import CurrentPolicy, Policy
from appliance.rpc.server import listen
from appliance.specifications.compiler_link import SpecificationCompiler
from appliance.specifications.specification_manager import SpecificationManager
from appliance.store.ends import EndTable
from appliance.store.state_file import StateStore
from appliance.telemetry.audit_trail import AuditTrail

RVMASTER, INNER, OWN = "rvmaster", "inner", "own"
"""The names of the listeners for nodes, for the ROS master, and for the appliance's own nodes."""

_log = structlog.get_logger()


@dataclass(frozen=True, slots=True)
class Foundation:
    """The durable state, the policy, the listeners, and the services that features provide."""

    settings: Settings
    lifeline: ControlLifeline
    compiler: SpecificationCompiler
    signing: SignerRequests
    audit: AuditLog
    trail: AuditTrail
    receipts: ReceiptFloor
    policy_services: PolicyServices
    calls: CallHolder
    own_services: OwnServiceTable
    monitors: Current[SpecificationManager]
    store: StateStore
    ends: EndTable
    hosts: SiteHosts
    policies: Policies
    registry: Registry
    quota_class: HostQuotaClass
    listener_limits: ListenerLimits
    sockets: Mapping[str, socket.socket]
    enforcement: Current[Enforcement]
    parameters_dirty: asyncio.Event
    role: ActiveRole

    def port(self, name: str) -> int:
        return int(self.sockets[name].getsockname()[1])


async def make_foundation(
    settings: Settings,
    lifeline: ControlLifeline,
    compiler: SpecificationCompiler,
    tunnels: Current[Tunnels],
    role: ActiveRole,
) -> Foundation:
    """Make the foundation; no policy is in force yet. Raises `StoreError`, and `OSError` if an address is in use.

    `tunnels` is set here, before the supervisor can report about tunnels.
    """
    policy, registry = CurrentPolicy(), Registry(settings.limits.nodes_per_host)
    quota_class = HostQuotaClass(policy, registry.registrations_of)
    log = _open_log(settings, lifeline, quota_class)
    state = _open_state(settings, role)
    # The policy names hosts by address. These addresses are reliable only once clear text from them is blocked, so
    # start the tunnels before the policy.
    hosts = _make_hosts(settings, lifeline, role, log, state)
    tunnels.set(hosts.tunnels)
    role.hand_tunnels_to(hosts.tunnels)
    await hosts.tunnels.start()
    services, enforcement = PolicyServices(), Current[Enforcement]()
    known = _policy_context(settings, lifeline, role, hosts, services=services, ends=state.ends)
    return Foundation(
        settings=settings,
        lifeline=lifeline,
        compiler=compiler,
        signing=log.signing,
        audit=log.audit,
        trail=log.trail,
        receipts=log.receipts,
        policy_services=services,
        calls=CallHolder(),
        own_services=OwnServiceTable(),
        monitors=Current(),
        store=state.store,
        ends=state.ends,
        hosts=hosts,
        policies=_make_policies(
            settings, state, log.trail, policy, known, services=services, enforcement=enforcement
        ),
        registry=registry,
        quota_class=quota_class,
        listener_limits=ListenerLimits(settings, log.trail, policy, quota_class),
        sockets=_open_listeners(settings, lifeline),
        enforcement=enforcement,
        parameters_dirty=asyncio.Event(),
        role=role,
    )


class _OpenState(NamedTuple):
    """The durable state."""

    store: StateStore
    ends: EndTable


def _open_state(settings: Settings, role: ActiveRole) -> _OpenState:
    folder = settings.state / "control"
    store = StateStore(folder, failed=lambda reason: _log.error("state is not written", reason=reason))
    role.inherit(store)
    return _OpenState(store, role.ends(store, folder / "age"))


def _make_hosts(
    settings: Settings, lifeline: ControlLifeline, role: ActiveRole, log: "_OpenLog", state: _OpenState
) -> SiteHosts:
    blocks = BlockTable(state.store, state.ends)
    table = make_host_table(settings, state.store)
    authority = role.host_authority(log.signing.link, state.store, log.trail, table)
    tunnels = Tunnels(
        table,
        log.trail,
        *authority,
        listen=settings.listen_address,
        say=lifeline.say,
        blocked=lambda: blocks.reasons,
    )
    blocks.on_change(tunnels.state_anew)
    return SiteHosts(blocks, table, tunnels, authority)


def _policy_context(
    settings: Settings,
    lifeline: ControlLifeline,
    role: ActiveRole,
    hosts: SiteHosts,
    *,
    services: PolicyServices,
    ends: EndTable,
) -> Callable[[], PolicyContext]:
    robot = robot_addresses(settings, role.robot)
    return lambda: services.added_to(
        replace(
            IN_CONTROL,
            hosts=dict(hosts.tunnels.addresses),
            robot=robot,
            own=frozenset(lifeline.surroundings.machine),
            site_keys=settings.site_keys,
            blocks=hosts.blocks.reasons,
            now=ends.system_time(),
            ends=passed_changes(ends),
        )
    )


def _make_policies(
    settings: Settings,
    state: _OpenState,
    trail: AuditTrail,
    policy: CurrentPolicy,
    known: Callable[[], PolicyContext],
    *,
    services: PolicyServices,
    enforcement: Current[Enforcement],
) -> Policies:
    """Make the policies, whose `enforcement` is assembled later."""

    def changed(_before: Policy, policy: Policy) -> int:
        services.changed()
        return enforcement().policy_changed(policy)

    return Policies(
        settings.policy,
        state.store,
        state.ends,
        trail,
        policy,
        known=known,
        live=lambda: enforcement().revocation.live(),  # noqa: PLW0108  it is assembled later
        changed=changed,
        carried_out=lambda: enforcement().relay.carried_out(),  # noqa: PLW0108  it is assembled later
    )


class _OpenLog(NamedTuple):
    """The audit log, and the parts that keep it."""

    signing: SignerRequests
    receipts: ReceiptFloor
    audit: AuditLog
    trail: AuditTrail


def _open_log(settings: Settings, lifeline: ControlLifeline, quota_class: HostQuotaClass) -> _OpenLog:
    log = Current[AuditLog]()
    signing = SignerRequests(log)
    receipts = ReceiptFloor(
        settings.state,
        int(settings.audit.reserve_bytes),
        holding=any(section.holds_records for section in settings.sections.values.values()),
    )
    held_by = lifeline.log_held()
    audit = open_audit(
        settings,
        signing,
        held_by,
        class_of=quota_class.of_text,
        group_of=quota_class.disk_group,
        receipts=receipts,
    )
    log.set(audit)
    strict, deny = settings.audit.durability == "strict", settings.audit.on_audit_failure == "deny"
    return _OpenLog(signing, receipts, audit, AuditTrail(audit, strict=strict, deny_when_failed=deny))


def _open_listeners(settings: Settings, lifeline: ControlLifeline) -> dict[str, socket.socket]:
    host, port = settings.listen_address
    sockets = lifeline.sockets
    for name, address in ((RVMASTER, (host, port)), (INNER, ("127.0.0.1", 0)), (OWN, ("127.0.0.1", 0))):
        if name not in sockets:
            sockets[name] = open_listener(*address)
            lifeline.keep(name, sockets[name])
    return sockets


def open_listener(host: str, port: int) -> socket.socket:
    try:
        return listen(host, port)
    except OSError as error:
        raise OSError(
            f"{host}:{port} cannot be listened on: {error.strerror}; "
            "is a ROS master running there? Stop it, or choose another --listen"
        ) from error
