"""The parameter calls, and the mirror of ROSMaster's parameter tree that survives its death.

The mirror changes exactly as ROSMaster's tree does, and only after ROSMaster took the change. So it answers what asks
for one value: a node that starts asks for hundreds (roscpp for five with every subscription). While ROSMaster is away
or not whole, such a question waits as all calls do.
"""

import time
from collections.abc import Callable, Iterable, Sequence
from typing import TYPE_CHECKING, NamedTuple, cast

from appliance.master.batch import Wanted
from appliance.master.calls.arguments import ApiUri
from appliance.master.calls.call import Answer, Caller, LimitReachedError, denial_text
from appliance.master.calls.parameter_charges import (
    APPLIANCE,
    NAME_WEIGHT,
    ParameterCharges,
    measure,
    member_weight,
)
from appliance.master.calls.registration import registering
from appliance.master.graph.registry import Incarnation, Kind
from appliance.policy.model import Address, Category, Request
from appliance.policy.rights import decide_right, right_to_read
from appliance.ros.errors import EncodingError, PeerError, ProtocolError
from appliance.ros.names import resolve_parameter
from appliance.ros.parameter_tree import Tree, parts_of, standing_at
from appliance.ros.xmlrpc import Value
from appliance.rpc.bulk import weigh
from appliance.rpc.client import CallFailedError
from appliance.rpc.server import Peer
from appliance.shares.pool import Pool

if TYPE_CHECKING:
    from appliance.master.core import Master

# Calls that go to ROSMaster together when they follow each other in a multicall, and how much of them.
IN_ORDER = frozenset({"setParam", "deleteParam", "hasParam"})
_TOGETHER_BYTES = 256 << 10


class ParameterMirror:
    """A copy of ROSMaster's parameter tree, and who is charged for it; `changed()` hears of every change.

    `weight` is about the bytes of the whole tree in an answer to `getParam("/")`. It and the depth are bounded: a
    tree that ROSMaster could not tell any more would break it for everybody, and could not be read after a restart.
    `note(key, value)` hears of each change of one parameter (None: it is gone); `since` are those after `tree`.
    """

    def __init__(
        self,
        tree: Tree,
        changed: Callable[[], None],
        charges: ParameterCharges,
        *,
        depth_limit: int = 100,
        note: Callable[[str, Value], None],
        since: Iterable[tuple[str, Value]] = (),
    ) -> None:
        self.tree = tree
        self.charges = charges
        self.weight = 0
        self._changed = changed
        self._note = note
        self._depth_limit = depth_limit
        for key, value in since:
            if value is None:
                self._take_out(key)
            else:
                self._put_in(key, value)
        self._recount(final=False)

    @property
    def bytes_limit(self) -> int:
        """What all parameters together may weigh."""
        return self.charges.pool.bounds.whole

    def check(self, key: str, depth: int) -> None:
        """Raise `ProtocolError` for a value that would be too deep."""
        if len(parts_of(key)) + depth > self._depth_limit:
            raise ProtocolError(f"parameter {key[:80]} would nest deeper than {self._depth_limit} levels")

    def reserve(self, key: str, weight: int, host: Address) -> "Reserved":
        """Keep room for a value that a host is about to set. Raises `LimitReachedError` when there is none for it.

        What takes no more than one host had there takes the place of that: it is charged to this host if it has room,
        and stays the other's if not. So whoever may write can always correct a parameter, and two hosts together get
        no more than their shares.
        """
        pool = self.charges.pool
        parts, before = self._place_of(key)
        held = self.charges.held(parts, before)
        after = _with_namespaces(key, len(parts), weight)
        growth = max(0, after - held[host])
        refusal = pool.take(host, growth) if growth else ""
        if not refusal:
            return Reserved(pool, host, growth, weight)
        former, most = held.most_common(1)[0]
        if after > most:
            raise LimitReachedError(f"parameter {key[:80]} is not set: {refusal}")
        return Reserved(pool, former, 0, weight)

    def replace(self, tree: Tree) -> None:
        """Take the tree that ROSMaster has."""
        self.tree = tree
        self._recount(final=True)
        self._changed()

    def set(self, key: str, value: Value, reserved: "Reserved") -> None:
        """`key` (canonical) has this value, which is the mirror's from now on; a dictionary replaces the namespace."""
        reserved.release()
        parts, before = self._place_of(key)
        self._put_in(key, value)
        after = _with_namespaces(key, len(parts), reserved.weight)
        self.charges.replaced(parts, before, after, reserved.owner)
        self.weight += after - before
        if parts:
            self._note(key, value)
        self._changed()

    def delete(self, key: str) -> None:
        """`key` (canonical) is gone."""
        parts = parts_of(key)
        there, in_the_way = standing_at(self.tree, key)
        if not parts or there is None or in_the_way is not None:
            return
        before = member_weight(parts[-1], there)
        self._take_out(key)
        self.charges.replaced(parts, before, 0, APPLIANCE)
        self.weight -= before
        self._note(key, None)
        self._changed()

    def _recount(self, *, final: bool) -> None:
        self.weight = measure(self.tree)[0]
        self.charges.recount(self.tree, final=final)

    def _place_of(self, key: str) -> tuple[list[str], int]:
        """The topmost key that is new, or another, when `key` is set; and what is there now, in bytes."""
        parts = parts_of(key)
        node: Value = self.tree
        for depth, part in enumerate(parts, 1):
            assert isinstance(node, dict)  # noqa: S101 - the root is one, and no other goes on; narrows for mypy
            if part not in node:
                return parts[:depth], 0
            if depth == len(parts) or not isinstance(node[part], dict):
                return parts[:depth], member_weight(part, node[part])
            node = node[part]
        return [], self.weight

    def _put_in(self, key: str, value: Value) -> None:
        parts = parts_of(key)
        if not parts:
            self.tree = cast(Tree, value)
            return
        node = self.tree
        for part in parts[:-1]:
            below = node.get(part)
            if not isinstance(below, dict):
                node[part] = below = {}
            node = below
        node[parts[-1]] = value

    def _take_out(self, key: str) -> None:
        above, _, name = key.rpartition("/")
        node, _ = standing_at(self.tree, above or "/")
        if isinstance(node, dict):
            node.pop(name, None)


class Reserved:
    """Room for a value of this weight until ROSMaster has it or refuses it; `owner` is charged for it."""

    __slots__ = ("_amount", "_pool", "owner", "weight")

    def __init__(self, pool: Pool[Address], owner: Address, amount: int, weight: int) -> None:
        self._pool = pool
        self._amount = amount
        self.owner = owner
        self.weight = weight

    def release(self) -> None:
        """It is set, and charged as what it is; or it could not be."""
        self._pool.give_back(self.owner, self._amount)
        self._amount = 0


def _with_namespaces(key: str, first: int, weight: int) -> int:
    """What a value of this weight takes with its name and those of its key from the `first` on, which are new."""
    if not first:
        return weight
    *namespaces, name = parts_of(key)[first - 1 :]
    return NAME_WEIGHT + len(name) + weight + sum(member_weight(part, {}) for part in namespaces)


async def get_param(master: "Master", caller: Caller, arguments: tuple[object, ...]) -> Answer:
    """`getParam(caller_id, key)`."""
    key = str(arguments[0])
    if master.rosmaster.reachable:
        there, _ = standing_at(master.parameters.tree, key)
        if there is None:
            return [-1, f"Parameter [{key}] is not set", 0]
        if not isinstance(there, dict):
            return [1, f"Parameter [{key}]", there]
    answer = await master.rosmaster.call("getParam", caller.caller_id, key)
    hidden = _hidden(master, caller, "getParam", key, answer)
    return answer if hidden is None else [0, hidden, 0]


def _hidden(master: "Master", caller: Caller, method: str, key: str, answer: Answer) -> str | None:
    """What a caller is told in the place of a namespace that he may not read; None when there is nothing to hide.

    It was decided before, by what was there then; ROSMaster answers with what is there now.
    """
    policy = master.policy()
    if (
        answer[0] != 1
        or not isinstance(answer[2], dict)
        or caller.own
        or not policy.has_section(Category.READ)
    ):
        return None
    request = Request(caller.peer.host, caller.caller_id, Category.READ, key)
    decision = decide_right(policy, right_to_read(request, answer[2]))
    if decision.allowed:
        return None
    record = master.recorder.decided(caller.asker, method, Category.READ.value, key, decision)
    return denial_text(decision, record, policy.tell)


def asks_for(mirror: ParameterMirror, params: Sequence[Value], enough: int) -> bool:
    """Whether `getParam` with these parameters, as they came, is for a namespace of about `enough` bytes or more."""
    if mirror.weight < enough:
        return False
    match params:
        case (str(caller_id), str(name)):
            try:
                there, _ = standing_at(mirror.tree, resolve_parameter(name, caller_id))
            except PeerError:
                return False
            return weigh(there, enough) >= enough
    return False


def may_be_told(master: "Master", incarnation: Incarnation, key: str, value: Value) -> bool:
    """Whether a node that subscribed to `key`, or to something above it, may read its new value; a denial is recorded.

    The value of a parameter that was deleted is an empty namespace.
    """
    policy = master.policy()
    if incarnation.own or not policy.has_section(Category.READ):
        return True
    request = Request(incarnation.host, incarnation.name, Category.READ, key)
    decision = decide_right(policy, right_to_read(request, value))
    if not decision.allowed:
        peer = Peer(incarnation.host, str(incarnation.host), incarnation.told)
        caller = Caller(peer, incarnation.name, time.monotonic_ns())
        master.recorder.decided(caller.asker, "paramUpdate", Category.READ.value, key, decision)
    return decision.allowed


async def has_param(master: "Master", caller: Caller, arguments: tuple[object, ...]) -> Answer:
    """`hasParam(caller_id, key)`."""
    key = str(arguments[0])
    if master.rosmaster.reachable:
        return [1, key, standing_at(master.parameters.tree, key)[0] is not None]
    return await master.rosmaster.call("hasParam", caller.caller_id, str(arguments[0]))


async def set_param(master: "Master", caller: Caller, arguments: tuple[object, ...]) -> Answer:
    """`setParam(caller_id, key, value)`."""
    [outcome] = await in_order(master, [(caller, "setParam", arguments)])
    if isinstance(outcome, Exception):
        raise outcome
    return outcome


def _is_set(answer: Answer, key: str, value: Value) -> bool:
    """Whether ROSMaster has a value now, by its answer to `setParam`.

    It has it before it looks whom to tell, and answers with an error when that fails (a name like `a/b` in a
    dictionary, and somebody who subscribed to what it looks like). What it does not take is a root that is none.
    """
    return answer[0] == 1 or key != "/" or isinstance(value, dict)


class _Part(NamedTuple):
    """A call on its way to ROSMaster, and the room that is kept for its value."""

    wanted: Wanted
    reserved: Reserved | None


async def in_order(
    master: "Master", wanted: Sequence[tuple[Caller, str, tuple[object, ...]]]
) -> list[Answer | Exception]:
    """Carry out several calls of `IN_ORDER` one after the other, in few requests: the outcome of each.

    A value is checked as if it came alone after those before it; one that fails holds up no other.
    """
    outcomes: list[Answer | Exception] = []
    waiting: list[_Part] = []
    weight = 0
    for caller, method, arguments in wanted:
        key, value = str(arguments[0]), cast(tuple[Value, ...], arguments[1:])
        try:
            measured, depth = measure(value[0]) if value else (0, 0)
            master.parameters.check(key, depth)
            if weight + measured + len(key) > _TOGETHER_BYTES:
                outcomes += await _send(master, waiting)
                waiting, weight = [], 0
            reserved = None
            if value:
                try:
                    reserved = master.parameters.reserve(key, measured, _charged(caller))
                except LimitReachedError:  # those before it may make room
                    outcomes += await _send(master, waiting)
                    waiting, weight = [], 0
                    reserved = master.parameters.reserve(key, measured, _charged(caller))
        except (ProtocolError, LimitReachedError) as error:
            outcomes += [*await _send(master, waiting), error]
            waiting, weight = [], 0
            continue
        waiting.append(_Part((method, (caller.caller_id, key, *value)), reserved))
        weight += NAME_WEIGHT + len(key) + measured
    return outcomes + await _send(master, waiting)


def _charged(caller: Caller) -> Address:
    return APPLIANCE if caller.own else caller.peer.host


async def _send(master: "Master", parts: list[_Part]) -> list[Answer | Exception]:
    """Make the calls; mirror, charges and subscribers follow what ROSMaster took."""
    try:
        outcomes = await _make(master, [part.wanted for part in parts])
    finally:
        for part in parts:
            if part.reserved is not None:
                part.reserved.release()
    for ((method, (caller_id, key, *value)), reserved), outcome in zip(parts, outcomes, strict=True):
        if isinstance(outcome, Exception):
            continue
        if reserved is not None and _is_set(outcome, str(key), value[0]):
            master.parameters.set(str(key), value[0], reserved)
            master.graph.parameter_set(str(key), value[0], str(caller_id))
        elif method == "deleteParam" and outcome[0] == 1:
            master.parameters.delete(str(key))
            master.graph.parameter_deleted(str(key))
    return outcomes


async def _make(master: "Master", calls: list[Wanted]) -> list[Answer | Exception]:
    """The outcomes of the calls, made as one if they are several."""
    if not calls:
        return []
    try:
        if len(calls) == 1:
            method, params = calls[0]
            return [await master.rosmaster.call(method, *params)]
        return list[Answer | Exception](await master.rosmaster.call_in_order(calls))
    except EncodingError as error:
        if len(calls) == 1:
            return [error]
        return [outcome for one in calls for outcome in await _make(master, [one])]  # nothing was sent yet
    except CallFailedError as error:
        return [error] * len(calls)


async def delete_param(master: "Master", caller: Caller, arguments: tuple[object, ...]) -> Answer:
    """`deleteParam(caller_id, key)`."""
    [outcome] = await in_order(master, [(caller, "deleteParam", arguments)])
    if isinstance(outcome, Exception):
        raise outcome
    return outcome


async def get_param_names(master: "Master", caller: Caller, _arguments: tuple[object, ...]) -> Answer:
    """`getParamNames(caller_id)`: those that the host may read."""
    answer = await master.rosmaster.call("getParamNames", caller.caller_id)
    policy = master.policy()
    if (
        answer[0] == 1
        and isinstance(answer[2], list)
        and policy.has_section(Category.READ)
        and not caller.own
    ):
        host, caller_id = caller.peer.host, caller.caller_id
        answer[2] = [
            name
            for name in answer[2]
            if isinstance(name, str) and policy.decide(Request(host, caller_id, Category.READ, name)).allowed
        ]
    return answer


async def subscribe_param(master: "Master", caller: Caller, arguments: tuple[object, ...]) -> Answer:
    """`subscribeParam(caller_id, caller_api, key)`."""
    api, key = cast(ApiUri, arguments[0]), str(arguments[1])
    async with registering(master, caller, api) as incarnation:
        answer = await master.rosmaster.call(
            "subscribeParam", caller.caller_id, master.faces.inner_uri(incarnation), key
        )
        hidden = _hidden(master, caller, "subscribeParam", key, answer)
        if hidden is not None:
            await master.rosmaster.call(
                "unsubscribeParam", caller.caller_id, master.faces.inner_uri(incarnation), key
            )
            return [0, hidden, 0]
        if answer[0] == 1:
            master.graph.registered(incarnation, Kind.PARAMETER, key, "")
        return answer


async def unsubscribe_param(master: "Master", caller: Caller, arguments: tuple[object, ...]) -> Answer:
    """`unsubscribeParam(caller_id, caller_api, key)`."""
    api, key = cast(ApiUri, arguments[0]), str(arguments[1])
    incarnation = master.faces.known(caller, api)
    inner = master.faces.inner_uri(incarnation) if incarnation is not None else master.faces.nobody()
    answer = await master.rosmaster.call("unsubscribeParam", caller.caller_id, inner, key)
    if answer[0] == 1 and incarnation is not None:
        master.graph.unregistered(incarnation, Kind.PARAMETER, key)
    return answer
