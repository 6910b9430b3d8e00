"""Make the store, the nodes, the ROS master and the relays agree with the registry, at the end of each turn.

1. A call is answered after its changes are flushed: they are stored, and the relay has them before a peer can use
   them. If a relay cannot take a change, operators' orders wait for it (`relay_control.py`).
2. Whatever else changes the registry, `soon` flushes it before the event loop waits again.
"""

import asyncio
from collections.abc import Iterable, Sequence
from contextlib import ExitStack
from dataclasses import dataclass

from appliance.base import clock
from appliance.master.endpoints.node_ports import NodePorts
from appliance.master.endpoints.proxy_endpoints import ProxyEndpoints
from appliance.master.endpoints.relay_control import RelayControl
from appliance.master.graph.graph import Grants
from appliance.master.graph.registry import (
    Change,
    Incarnation,
    Kind,
    Life,
    NodeRegistration,
    RegistrationKey,
    Registry,
)
from appliance.master.graph.revocation import Revocation
from appliance.master.reconcile.subscribers import Subscribers
from appliance.master.rosmaster import MasterRegistrations
from appliance.policy.model import Address, address_of
from appliance.policy.policy import Policy
from appliance.store.state_file import IncarnationRow, PermissionRow, RegistrationRow, StateStore
from roswire.uris import parse_node_uri


@dataclass(frozen=True, slots=True)
class Sinks:
    """All sinks of the registry."""

    registry: Registry
    grants: Grants
    store: StateStore
    subscribers: Subscribers
    entries: MasterRegistrations
    relay: RelayControl
    faces: ProxyEndpoints

    def soon(self) -> None:
        asyncio.get_running_loop().call_soon(self.flush)

    def flush(self) -> None:
        """Send all changes. The endpoints of ended nodes close last, when no sink uses their ports."""
        changed = self.registry.take_changes()
        if not changed:
            return
        with ExitStack() as others:  # a defect of a sink takes no change from the others
            others.callback(self._close_ended, changed)
            for sink in (self.relay, self.entries, self.subscribers):
                others.callback(sink.flush, changed)
            save(changed, self.grants, self.store)

    def _close_ended(self, changed: Iterable[Change]) -> None:
        for node in changed:
            if isinstance(node, Incarnation) and node.life in {Life.REPLACED, Life.FORGOTTEN}:
                self.relay.carried.forgotten(node.key)
                self.faces.close(node)


@dataclass(frozen=True, slots=True)
class Enforcement:
    """Revokes rights that are no longer allowed."""

    revocation: Revocation
    sinks: Sinks
    places: NodePorts

    def policy_changed(self, policy: Policy) -> int:
        """Enforce a policy that is already in force. Return the number of revoked rights.

        The policy may use another range of ports, and name hosts differently.
        """
        self.places.policy_changed(policy.ports)
        count = self.revocation.redecide()
        self.sinks.flush()
        self.sinks.relay.compare()
        return count

    def expel(self, host: Address, reason: str) -> int:
        count = self.revocation.expel(host, reason)
        self.sinks.flush()
        return count

    def redecide_for(self, host: Address, caller_id: str) -> None:
        self.revocation.redecide_for(host, caller_id)
        self.sinks.flush()


_TOGETHER = 1000  # changes that are written together
_SHELVED = "revoked "  # the prefix of the stored kind of a withdrawn registration


def save(changed: Sequence[Change], grants: Grants, store: StateStore) -> None:
    """Store the present state of what has changed.

    After a crash, the store has all changes of a turn or none. Only a turn with thousands of changes is divided, so
    that no other change waits for one large write.
    """
    for begin in range(0, len(changed), _TOGETHER):
        with store.database.together():
            for change in changed[begin : begin + _TOGETHER]:
                _save(change, grants, store)


def _save(change: Change, grants: Grants, store: StateStore) -> None:
    match change:
        case Incarnation(life=Life.FORGOTTEN):
            store.forget_incarnation(change.key)  # with its registrations and grants
        case Incarnation():
            store.save_incarnation(
                IncarnationRow(
                    change.key, change.name, str(change.host), change.api_text, change.told, change.outer_port,
                    change.relay_port, change.own, change.life.value, change.changed, change.more_relay_ports,
                )
            )  # fmt: skip
        case RegistrationKey(node, kind, resource, shelved) if node.life is not Life.FORGOTTEN:
            stored_kind = f"{_SHELVED}{kind.value}" if shelved else kind.value
            one = (node.shelf if shelved else node.registrations).get((kind, resource))
            if one is None:
                store.remove_registration(node.key, stored_kind, resource)
            else:
                store.save_registration(
                    RegistrationRow(node.key, stored_kind, resource, one.detail, one.order)
                )
        case PermissionRow():
            if change in grants.of(change.key):
                store.save_permission(change)
            else:
                store.remove_permission(change)


def restore(registry: Registry, store: StateStore) -> int:
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
