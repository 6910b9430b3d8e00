"""Make the first part of control: the store, the audit log, the policy, the tunnels and the listening sockets."""

import asyncio
import socket
from collections.abc import Mapping
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
from appliance.control.assembly.policies import Policies
from appliance.control.assembly.robot import robot_addresses
from appliance.control.assembly.services import CallHolder, OwnServiceTable, PolicyServices
from appliance.control.links.signer_requests import ReceiptFloor, SignerRequests
from appliance.control.links.supervisor_link import ControlLifeline
from appliance.hosts.tunnel_state import Tunnels
from appliance.master.graph.registry import Registry
from appliance.master.reconcile.sinks import Enforcement
from appliance.policy.judgement import IN_CONTROL
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
    monitors, enforcement = Current[SpecificationManager](), Current[Enforcement]()
    signing, receipts, audit, trail = _open_log(settings, lifeline, quota_class)
    services = PolicyServices()
    store = StateStore(
        settings.state / "control", failed=lambda reason: _log.error("state is not written", reason=reason)
    )
    role.inherit(store)
    ends = role.ends(store, settings.state / "control" / "age")
    blocks = BlockTable(store, ends)
    # The policy names hosts by address. These addresses are reliable only once clear text from them is blocked, so
    # start the tunnels before the policy.
    table = make_host_table(settings, store)
    host_authority = role.host_authority(signing.link, store, trail, table)
    tunnels.set(
        Tunnels(
            table,
            trail,
            *host_authority,
            listen=settings.listen_address,
            say=lifeline.say,
            blocked=lambda: blocks.reasons,
        )
    )
    blocks.on_change(tunnels().state_anew)
    role.hand_tunnels_to(tunnels())
    await tunnels().start()

    def changed(_before: Policy, policy: Policy) -> int:
        services.changed()
        return enforcement().policy_changed(policy)

    robot = robot_addresses(settings, role.robot)

    policies = Policies(
        settings.policy,
        store,
        ends,
        trail,
        policy,
        known=lambda: services.added_to(
            replace(
                IN_CONTROL,
                hosts=dict(tunnels().addresses),
                robot=robot,
                own=frozenset(lifeline.surroundings.machine),
                site_keys=settings.site_keys,
                blocks=blocks.reasons,
            )
        ),
        live=lambda: enforcement().revocation.live(),  # noqa: PLW0108  it is assembled later
        changed=changed,
        carried_out=lambda: enforcement().relay.carried_out(),  # noqa: PLW0108  it is assembled later
    )
    return Foundation(
        settings=settings,
        lifeline=lifeline,
        compiler=compiler,
        signing=signing,
        audit=audit,
        trail=trail,
        receipts=receipts,
        policy_services=services,
        calls=CallHolder(),
        own_services=OwnServiceTable(),
        monitors=monitors,
        store=store,
        ends=ends,
        hosts=SiteHosts(blocks, table, tunnels(), host_authority),
        policies=policies,
        registry=registry,
        quota_class=quota_class,
        listener_limits=ListenerLimits(settings, trail, policy, quota_class),
        sockets=_open_listeners(settings, lifeline),
        enforcement=enforcement,
        parameters_dirty=asyncio.Event(),
        role=role,
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
