"""Make the first part of control: the store, the audit log, the policy, the tunnels and the listening sockets."""

import asyncio
import socket
from collections.abc import Mapping
from dataclasses import dataclass
from typing import NamedTuple

import structlog

from appliance.audit.log.log import AuditLog
from appliance.configuration.settings import Settings
from appliance.control.assembly.active_role import ActiveRole
from appliance.control.assembly.current import Current
from appliance.control.assembly.host_authority import HostAuthority, make_host_table
from appliance.control.assembly.host_blocks import BlockTable
from appliance.control.assembly.listener_limits import HostQuotaClass, ListenerLimits
from appliance.control.assembly.open_audit import open_audit
from appliance.control.assembly.policies import Policies, surroundings
from appliance.control.assembly.robot import charged_to, robot_addresses
from appliance.control.links.signer_requests import ReceiptFloor, SignerRequests
from appliance.control.links.supervisor_link import ControlLifeline
from appliance.features.feature import FeatureContext
from appliance.features.parts import FeatureParts
from appliance.hosts.host_table import HostTable
from appliance.hosts.tunnel_state import Tunnels
from appliance.master.graph.registry import Registry
from appliance.master.reconcile.sinks import Enforcement
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
    """The durable state, the policy and the listeners."""

    settings: Settings
    lifeline: ControlLifeline
    compiler: SpecificationCompiler
    signing: SignerRequests
    host_authority: HostAuthority
    audit: AuditLog
    receipts: ReceiptFloor
    trail: AuditTrail
    features: FeatureParts
    monitors: Current[SpecificationManager]
    store: StateStore
    ends: EndTable
    blocks: BlockTable
    table: HostTable
    tunnels: Tunnels
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
    *,
    restarted: bool,
) -> Foundation:
    """Make the foundation. Raises `PolicyRefusedError`, `StoreError`, and `OSError` if an address is in use.

    `tunnels` is set here, before the supervisor can report about tunnels.
    """
    policy, registry = CurrentPolicy(), Registry(settings.limits.nodes_per_host)
    quota_class = HostQuotaClass(policy, registry.registrations_of)
    monitors, enforcement = Current[SpecificationManager](), Current[Enforcement]()
    signing, receipts, audit, trail = _open_log(settings, lifeline, quota_class)
    features = FeatureParts(
        FeatureContext(
            settings.sections,
            trail,
            audit,
            settings.name,
            charged_to=lambda host: charged_to(policy(), host),
            in_force=lambda: (trail.revision, monitors().revision),
        )
    )
    store = StateStore(
        settings.state / "control", failed=lambda reason: _log.error("state is not written", reason=reason)
    )
    role.inherit(store)
    ends = role.ends(store, settings.state / "control" / "age")
    blocks = BlockTable(store, ends)
    await features.keep(store, lifeline)
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
        features.policy_changed()
        return enforcement().policy_changed(policy)

    robot = robot_addresses(settings, role.robot)

    policies = Policies(
        settings.policy,
        store,
        ends,
        trail,
        policy,
        known=lambda: surroundings(
            {**tunnels().addresses, **features.addresses()},
            robot,
            own=lifeline.surroundings.machine,
            site_keys=settings.site_keys,
            blocks=blocks.reasons,
            holders=features.holders(),
            approved=features.approved(),
        ),
        live=lambda: enforcement().revocation.live(),  # noqa: PLW0108  it is assembled later
        changed=changed,
        carried_out=lambda: enforcement().relay.carried_out(),  # noqa: PLW0108  it is assembled later
    )
    policies.start(restarted=restarted or role.paired)
    return Foundation(
        settings=settings,
        lifeline=lifeline,
        compiler=compiler,
        signing=signing,
        host_authority=host_authority,
        audit=audit,
        receipts=receipts,
        trail=trail,
        features=features,
        monitors=monitors,
        store=store,
        ends=ends,
        blocks=blocks,
        table=table,
        tunnels=tunnels(),
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
