"""Carry out the effects of changes of the graph (`effects.py`). All other code only returns effects.

After a restart, `restore` reads the registry from the store.
"""

from collections.abc import Iterable
from dataclasses import dataclass
from typing import assert_never

from appliance.base import clock
from appliance.master.endpoints.delivery import Delivery
from appliance.master.endpoints.node_ports import NodePorts
from appliance.master.endpoints.proxy_endpoints import ProxyEndpoints
from appliance.master.endpoints.relay_control import RelayControl
from appliance.master.graph.effects import (
    CloseNode,
    DropCalls,
    Effect,
    Effects,
    EraseGrant,
    RegisterAtMaster,
    SaveGrant,
    TellNode,
    UnregisterAtMaster,
    UsePorts,
    WriteRecord,
)
from appliance.master.graph.graph import RosGraph
from appliance.master.graph.registry import (
    Durable,
    EraseNode,
    EraseRegistration,
    Incarnation,
    Kind,
    Life,
    NodeRegistration,
    Registry,
    SaveNode,
    SaveRegistration,
)
from appliance.master.graph.revocation import Revocation, revoked
from appliance.master.reconcile.entries import MasterRegistrations
from appliance.policy.model import Address, address_of
from appliance.policy.policy import Policy
from appliance.store.state_file import IncarnationRow, RegistrationRow, StateStore
from appliance.telemetry.audit_trail import AuditTrail
from roswire.uris import parse_node_uri


@dataclass(slots=True)
class Enactor:
    """Carry out effects on nodes, relays, the ROS master (in order), the store and the audit log."""

    graph: RosGraph
    entries: MasterRegistrations
    store: StateStore
    trail: AuditTrail
    delivery: Delivery
    relay: RelayControl
    faces: ProxyEndpoints
    places: NodePorts

    def carry_out(self, effects: Iterable[Effect]) -> None:
        """Carry out effects now, in this order. The ROS master gets its changes later, in this order."""
        for effect in effects:
            match effect:
                case TellNode(node, call):
                    self.delivery.push(node, call)
                case DropCalls(node):
                    self.delivery.drop(node)
                case CloseNode(node):
                    self.relay.carried.forgotten(node.key)
                    self.faces.close(node)
                case UsePorts(ports):
                    self.places.policy_changed(ports)
                case RegisterAtMaster(node, registration):
                    self.entries.make(node, registration)
                case UnregisterAtMaster(node, registration):
                    self.entries.end(node, registration)
                case SaveGrant(row):
                    self.store.save_permission(row)
                case EraseGrant(row):
                    self.store.remove_permission(row)
                case SaveNode() | EraseNode() | SaveRegistration() | EraseRegistration():
                    write(effect, self.store)
                case WriteRecord():
                    self.trail.happened(
                        effect.event,
                        effect.reason,
                        severity=effect.severity,
                        host=effect.host,
                        caller_id=effect.caller_id,
                        category=effect.category,
                        resource=effect.resource,
                        rule=effect.rule,
                        decision=effect.decision,
                        more=effect.more,
                    )
                case _:
                    assert_never(effect)
        self.relay.flush(self.graph.registry.take_changes())


@dataclass(frozen=True, slots=True)
class Enforcement:
    """Revoke rights that are no longer allowed."""

    revocation: Revocation
    enactor: Enactor

    def policy_changed(self, policy: Policy) -> int:
        """Revoke rights that a new policy does not allow, and state its limits. Return the number of revocations."""
        count = self._take_back(self.revocation.policy_changed(policy))
        self.enactor.relay.compare()
        return count

    def expel(self, host: Address, reason: str) -> int:
        return self._take_back(self.revocation.expel(host, reason))

    def redecide_for(self, host: Address, caller_id: str) -> None:
        self.enactor.carry_out(self.revocation.redecide_for(host, caller_id))

    async def carried_out(self) -> None:
        await self.enactor.relay.carried_out()

    def _take_back(self, effects: Effects) -> int:
        self.enactor.carry_out(effects)
        return revoked(effects)


_SHELVED = "revoked "  # the prefix of the stored kind of a withdrawn registration


def write(effect: Durable, store: StateStore) -> None:
    match effect:
        case SaveNode(node):
            store.save_incarnation(
                IncarnationRow(
                    node.key, node.name, str(node.host), node.api_text, node.told, node.outer_port, node.relay_port,
                    node.own, node.life.value, node.changed, node.more_relay_ports,
                )
            )  # fmt: skip
        case EraseNode(key):
            store.forget_incarnation(key)
        case SaveRegistration(key, one, shelved):
            store.save_registration(
                RegistrationRow(key, _kept_kind(one.kind, shelved), one.resource, one.detail, one.order)
            )
        case EraseRegistration(key, kind, resource, shelved):
            store.remove_registration(key, _kept_kind(kind, shelved), resource)


def _kept_kind(kind: Kind, shelved: bool) -> str:
    return f"{_SHELVED}{kind.value}" if shelved else kind.value


def restore(registry: Registry, store: StateStore) -> int:
    """Fill `registry` from the store; return the number of incarnations."""
    incarnations, registrations = store.load_registry()
    by_key = {
        row.key: Incarnation(
            key=row.key,
            name=row.name,
            host=address_of(row.host),
            api=parse_node_uri(row.api),
            api_text=row.api,
            told=row.told,
            outer_port=row.outer_port,
            relay_port=row.relay_port,
            own=row.own,
            life=Life(row.life),
            changed=clock.now(),  # the stored time may be from before a restart of the machine
            more_relay_ports=row.more_relay_ports,
        )
        for row in incarnations
    }
    for row in registrations:
        owner = by_key.get(row.key)
        if owner is not None:
            kind = Kind(row.kind.removeprefix(_SHELVED))
            place = owner.shelf if row.kind.startswith(_SHELVED) else owner.registrations
            place[kind, row.resource] = NodeRegistration(kind, row.resource, row.detail, row.ordinal)
    for incarnation in by_key.values():
        registry.restore(incarnation)
    return len(by_key)
