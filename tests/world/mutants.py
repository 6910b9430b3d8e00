"""Faults of the product that the world must find, each with the replaced attribute and its replacement.

python -m tests.world.mutants SEEDS [WORD]   print the first seed that finds each, or those with this word
"""

import contextlib
import sys
from collections.abc import Callable, Iterator, Sequence
from typing import Any

from appliance.control import process as control_process
from appliance.features.standby.lease import ApplianceLease
from appliance.features.standby.pairing import LeaseWatch
from appliance.features.standby.passive import PassiveControl
from appliance.features.standby.replica import Replica
from appliance.features.standby.replication import Replication
from appliance.features.standby.replication_sender import ReplicationSender
from appliance.features.standby.witness import lease_rules
from appliance.features.standby.witness.firewall import LeaseFirewall
from appliance.master.calls.call_execution import Execution
from appliance.master.calls.gate import CallGate
from appliance.master.endpoints.relay_control import RelayControl
from appliance.master.graph.graph import RosGraph
from appliance.master.graph.registry import Incarnation, RegistrationKey, Registry
from appliance.master.graph.revocation import Revocation
from appliance.master.reconcile.reconciler import Reconciler
from appliance.master.reconcile.sinks import Enforcement
from appliance.master.reconcile.subscribers import Subscribers
from appliance.policy.model import Decision
from appliance.relay.grant_table import GrantTable
from appliance.store.changes import Value
from appliance.store.state_file import PermissionRow, StateStore
from appliance.store.writer_thread import Database
from appliance.telemetry.audit_trail import AuditTrail
from tests.world.pair import PairWorld
from tests.world.world import World, run


def _nothing(*_given: Any, **_named: Any) -> Any:
    return 0


async def _at_once(*_given: Any, **_named: Any) -> None: ...


_attach, _state_fact = RelayControl.attach, vars(RelayControl)["_state_fact"]


def _without_grants(self: RelayControl, index: int, channel: Any) -> None:
    vars(self.grants)["of"] = lambda _key: ()
    try:
        _attach(self, index, channel)
    finally:
        del vars(self.grants)["of"]


def _not_stated(kind: type[Any], *, withdrawn: bool = False) -> Callable[..., None]:
    def state(self: RelayControl, post: Any, node: Incarnation, fact: Any, wanted: Any) -> None:
        if not (isinstance(fact, kind) and (wanted is None) is withdrawn):
            _state_fact(self, post, node, fact, wanted)

    return state


_put = Database.put


def _not_ahead(self: Database, table: str, *row: Value, **_ahead: bool) -> None:
    _put(self, table, *row, ahead=False)


def _allowed(_gate: CallGate, _attempt: Any, _tree: Any) -> Decision:
    return Decision(True, None, "by a fault")


def _unrecorded(_execution: Execution, _attempt: Any, decision: Decision) -> Any:
    return None if decision.allowed else [0, decision.reason, 0]


MUTANTS: dict[str, tuple[Any, str, Any]] = {
    "a subscriber is not told of a new publisher": (Subscribers, "_state", _nothing),
    "nodes are told each other's own URIs": (Incarnation, "uri_for", lambda node, _told, hidden: node.real_uri),
    "a reload takes back no registration": (RosGraph, "revoked", _nothing),
    "a reload takes back no grant": (Revocation, "_revoke", _nothing),
    "what a policy took is not put back": (Revocation, "returned", _nothing),
    "an earlier life keeps its name": (RosGraph, "_take_name", _nothing),
    "a lost node keeps its publications": (Registry, "_unindex", _nothing),
    "a new relay is not told of grants": (RelayControl, "attach", _without_grants),
    "a grant is not kept": (StateStore, "save_permission", _nothing),
    "a registration is not kept": (StateStore, "save_registration", _nothing),
    "the relay is not told of a grant": (RelayControl, "_state_fact", _not_stated(PermissionRow)),
    "the relay is not told what is revoked": (
        RelayControl, "_state_fact", _not_stated(PermissionRow, withdrawn=True),
    ),
    "the relay is not told who publishes": (RelayControl, "_state_fact", _not_stated(RegistrationKey)),
    "a round leaves the ROS master as it is": (Reconciler, "_compare", _at_once),
    "a node that comes back is placed nowhere": (RelayControl, "_state_node", _nothing),
    "every call is allowed": (CallGate, "decide", _allowed),
    "a decision is not recorded": (Execution, "_record", _unrecorded),
    "a strict answer does not wait for its record": (AuditTrail, "durable", _at_once),
    "a reload is answered before the relay has carried it out": (RelayControl, "carried_out", _at_once),
    "a call that began under the old policy is not decided again": (
        Enforcement, "redecide_for", lambda *_given: None,
    ),
    "a reload revokes nothing": (Enforcement, "policy_changed", lambda *_given: 0),
    "a policy is not stored": (StateStore, "save_revision", _nothing),
    "a parameter is not stored": (StateStore, "note_parameter", _nothing),
    "control restores no node": (control_process, "restore_nodes", _at_once),
    "a change is not written ahead": (
        Database, "put", _not_ahead,
    ),
    "the relay keeps what was not stated again": (GrantTable, "end", _nothing),
    "a revoked grant is kept in the store": (StateStore, "remove_permission", _nothing),
}  # fmt: skip


PAIR_MUTANTS: dict[str, tuple[Any, str, Any]] = {
    "an answer does not wait for the standby": (Replication, "until_stored", _at_once),
    "every change counts as acknowledged by the standby": (ReplicationSender, "until_acknowledged", _at_once),
    "the standby acknowledges what it does not store": (Replica, "_execute", _nothing),
    "data of an earlier active appliance is accepted": (PassiveControl, "_accepts", lambda *_given: True),
    "an appliance serves longer than its lease": (LeaseWatch, "_seconds_left", lambda _watch: 1000.0),
    "an ended lease ends nothing": (LeaseWatch, "ended", lambda _watch: None),
    "a lapsed lease stops nothing": (LeaseWatch, "lapsed", lambda _watch: None),
    "a promise not to claim is not kept": (
        ApplianceLease, "is_active", lambda lease, now: lease.held is not None and now < lease.valid_until,
    ),
    "the robot's firewall stays as it is": (LeaseFirewall, "admit", _nothing),
    "the witness grants before the expiry": (lease_rules, "EXPIRY", 0.1),
}  # fmt: skip


NOT_SEEN = {
    "a reload takes back no grant",
    "a call that began under the old policy is not decided again",
    "the relay keeps what was not stated again",
    "a revoked grant is kept in the store",
    "data of an earlier active appliance is accepted",
    "an appliance serves longer than its lease",
    "a promise not to claim is not kept",
    "the robot's firewall stays as it is",
    "the witness grants before the expiry",
}
"""Faults that 200 seeds (60 of two appliances) did not find, or that were not searched for yet."""


@contextlib.contextmanager
def instead_of(place: Any, name: str, other: object) -> Iterator[None]:
    before = getattr(place, name)
    setattr(place, name, other)
    try:
        yield
    finally:
        setattr(place, name, before)


def first_broken(mutant: str, seeds: Sequence[int]) -> tuple[int, str] | None:
    kind = World if mutant in MUTANTS else PairWorld
    with instead_of(*(MUTANTS | PAIR_MUTANTS)[mutant]):
        for seed in seeds:
            try:
                run(seed, kind=kind)
            except (AssertionError, KeyError) as error:
                return seed, str(error)
    return None


def main(arguments: list[str]) -> None:
    number, *words = arguments
    for mutant in MUTANTS | PAIR_MUTANTS:
        if all(word in mutant for word in words):
            found = first_broken(mutant, range(int(number)))
            sys.stdout.write(
                f"{mutant}: {'not found' if found is None else f'seed {found[0]}: {found[1][:120]}'}\n"
            )
            sys.stdout.flush()


if __name__ == "__main__":
    main(sys.argv[1:])
