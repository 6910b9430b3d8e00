"""Carries out what follows from changes of the graph (`effects`): the one place where they touch the world.

What the store was told of the registry comes back after a restart (`restore`).
"""

import asyncio
import time
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from typing import assert_never

import structlog

from appliance.master.endpoints.delivery import Delivery
from appliance.master.endpoints.endpoint_addresses import Places
from appliance.master.endpoints.proxy_endpoints import Faces
from appliance.master.endpoints.relay_control import RelayControl
from appliance.master.graph.effects import (
    CloseNode,
    DropCalls,
    Effect,
    EraseGrant,
    Place,
    PlaceGrant,
    PlaceNode,
    PutBack,
    Record,
    RevokeGrant,
    SaveGrant,
    TakeBack,
    TellNode,
    UsePorts,
    Withdraw,
    WithdrawNode,
)
from appliance.master.graph.graph import Graph
from appliance.master.graph.registry import (
    Durable,
    EraseNode,
    EraseRegistration,
    Incarnation,
    Kind,
    Life,
    Registration,
    Registry,
    SaveNode,
    SaveRegistration,
)
from appliance.master.reconcile.entries import Entries
from appliance.policy.model import address_of
from appliance.rpc.xmlrpc_client import CallFailedError
from appliance.store.state_file import IncarnationRow, RegistrationRow, StateStore
from appliance.telemetry.audit_trail import AuditTrail
from roswire.uris import parse_node_uri

_log = structlog.get_logger()


@dataclass(slots=True)
class Enactor:
    """Tells nodes, relays, ROSMaster, the store and the audit log. ROSMaster hears of changes in their order."""

    graph: Graph
    entries: Entries
    store: StateStore
    trail: AuditTrail
    delivery: Delivery
    relay: RelayControl
    faces: Faces
    places: Places
    _last: asyncio.Task[None] | None = None  # of what ROSMaster is told

    def carry_out(self, effects: Iterable[Effect]) -> None:
        """Do all of this, now and in this order; what ROSMaster is told is done in its turn."""
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
                case PutBack() | TakeBack():
                    self._last = asyncio.get_running_loop().create_task(self._tell_master(effect, self._last))
                case SaveGrant(row):
                    self.store.save_permission(row)
                case EraseGrant(row):
                    self.store.remove_permission(row)
                case SaveNode() | EraseNode() | SaveRegistration() | EraseRegistration():
                    write(effect, self.store)
                case Record():
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
                    self._tell_relays(effect)

    def _tell_relays(
        self, effect: Place | Withdraw | PlaceNode | WithdrawNode | PlaceGrant | RevokeGrant
    ) -> None:
        match effect:
            case Place(node, kind, resource, detail):
                self.relay.place(node, kind, resource, detail)
            case Withdraw(node, kind, resource):
                self.relay.withdraw(node, kind, resource)
            case PlaceNode(node):
                self.relay.place_node(node)
            case WithdrawNode(node):
                self.relay.withdraw_node(node)
            case PlaceGrant(row):
                self.relay.place_grant(row)
            case RevokeGrant(row):
                self.relay.revoke_grant(row)
            case _:
                assert_never(effect)

    # --- ROSMaster ---

    async def put_back(self, node: Incarnation, registrations: Sequence[Registration]) -> None:
        """Tell ROSMaster what a returned node has. A call that fails is made up for by the reconcile loop."""
        try:
            values = await self.entries.put_back(node, registrations)
        except CallFailedError as error:
            _not_told(node, error)
            return
        for key, value in values:
            self.carry_out(self.graph.tell_parameter(node, key, value))

    async def take_out(self, node: Incarnation, registrations: Sequence[Registration]) -> None:
        """Tell ROSMaster what a lost node has no more. A call that fails is made up for by the reconcile loop."""
        try:
            await self.entries.end_lost(node, registrations)
        except CallFailedError as error:
            _not_told(node, error)

    async def _tell_master(self, effect: PutBack | TakeBack, before: asyncio.Task[None] | None) -> None:
        if before is not None:
            await asyncio.wait([before])
        if isinstance(effect, PutBack):
            await self.put_back(effect.node, effect.registrations)
            return
        node, taken = effect.node, effect.registration
        if (taken.kind, taken.resource) in node.registrations:  # it has been granted again
            return
        try:
            await self.entries.end(node, taken.kind, taken.resource)
        except CallFailedError as error:
            _not_told(node, error)


def _not_told(node: Incarnation, error: CallFailedError) -> None:
    _log.warning("ROSMaster was not told", node=node.name, error=str(error))


_SHELVED = "revoked "  # before the kind of a registration that the policy took back


def write(effect: Durable, store: StateStore) -> None:
    """Keep one change of the registry."""
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
    """Fill `registry` with what the store kept; the number of incarnations."""
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
            changed=time.monotonic(),  # the row's may be of another life of the machine: only its order counts
            more_relay_ports=row.more_relay_ports,
        )
        for row in incarnations
    }
    for row in registrations:
        owner = by_key.get(row.key)
        if owner is not None:
            kind = Kind(row.kind.removeprefix(_SHELVED))
            place = owner.shelf if row.kind.startswith(_SHELVED) else owner.registrations
            place[kind, row.resource] = Registration(kind, row.resource, row.detail, row.ordinal)
    for incarnation in by_key.values():
        registry.restore(incarnation)
    return len(by_key)
