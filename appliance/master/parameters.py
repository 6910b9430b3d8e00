"""The parameter calls, and the mirror of ROSMaster's parameter tree that survives its death.

The mirror changes exactly as ROSMaster's tree does, and only after ROSMaster took the change.
"""

import time
from collections.abc import Callable, Iterable, Sequence
from typing import TYPE_CHECKING, cast

from appliance.master.arguments import ApiUri
from appliance.master.batch import Wanted
from appliance.master.bulk import weigh
from appliance.master.call import Answer, Caller, LimitReachedError, denial_text
from appliance.master.client import CallFailedError
from appliance.master.http import Peer
from appliance.master.registration import incarnation_of
from appliance.master.registry import Incarnation, Kind
from appliance.policy.model import Category, Request
from appliance.ros.errors import EncodingError, PeerError, ProtocolError
from appliance.ros.names import resolve_parameter
from appliance.ros.xmlrpc import Value

if TYPE_CHECKING:
    from appliance.master.core import Master

Tree = dict[str, Value]
# Calls that go to ROSMaster together when they follow each other in a multicall, and how much of them.
IN_ORDER = frozenset({"setParam", "deleteParam", "hasParam"})
_TOGETHER_BYTES = 256 << 10
_NAME_WEIGHT = 40


class ParameterMirror:
    """A copy of ROSMaster's parameter tree, and how much there is of it; `changed()` hears of every change.

    `weight` is about the bytes of the whole tree in an answer to `getParam("/")`. It and the depth are bounded: a
    tree that ROSMaster could not tell any more would break it for everybody, and could not be read after a restart.
    `bytes_limit` is what all parameters together may weigh.
    `note(key, value)` hears of each change of one parameter (None: it is gone); `since` are those after `tree`.
    """

    def __init__(
        self,
        tree: Tree,
        changed: Callable[[], None],
        *,
        bytes_limit: int = 64 << 20,
        depth_limit: int = 100,
        note: Callable[[str, Value], None] = lambda _key, _value: None,
        since: Iterable[tuple[str, Value]] = (),
    ) -> None:
        self.tree = tree
        self.weight = measure(tree)[0]
        self._changed = changed
        self._note: Callable[[str, Value], None] = lambda _key, _value: None
        for key, value in since:
            if value is None:
                self.delete(key)
            else:
                self.set(key, value)
        self._note = note
        self.bytes_limit = bytes_limit
        self._depth_limit = depth_limit

    def check(self, key: str, value: Value) -> None:
        """Raise `ProtocolError` or `LimitReachedError` for a value that would be too deep or too much."""
        weight, depth = measure(value)
        if len(_parts(key)) + depth > self._depth_limit:
            raise ProtocolError(f"parameter {key[:80]} would nest deeper than {self._depth_limit} levels")
        if self.weight + weight > self.bytes_limit:
            raise LimitReachedError(
                f"all parameters together would have {self.weight + weight} bytes; the limit is {self.bytes_limit}"
            )

    def has_room(self, weight: int) -> bool:
        """Whether so much can come in addition to what is there."""
        return self.weight + weight <= self.bytes_limit

    def replace(self, tree: Tree) -> None:
        """Take the tree that ROSMaster has."""
        self.tree = tree
        self.weight = measure(tree)[0]
        self._changed()

    def set(self, key: str, value: Value) -> None:
        """`key` (canonical) has this value, which is the mirror's from now on; a dictionary replaces the namespace."""
        parts = _parts(key)
        if not parts:
            self.replace(cast(Tree, value))
            return
        node = self.tree
        for part in parts[:-1]:
            below = node.get(part)
            if not isinstance(below, dict):
                below = {}
                self._put(node, part, below)
            node = below
        self._put(node, parts[-1], value)
        self._note(key, value)
        self._changed()

    def delete(self, key: str) -> None:
        """`key` (canonical) is gone."""
        parts = _parts(key)
        node: Value = self.tree
        for part in parts[:-1]:
            if not isinstance(node, dict):
                return
            node = node.get(part)
        if parts and isinstance(node, dict) and parts[-1] in node:
            self.weight -= _member(parts[-1], node.pop(parts[-1]))
            self._note(key, None)
            self._changed()

    def _put(self, node: Tree, name: str, value: Value) -> None:
        if name in node:
            self.weight -= _member(name, node[name])
        node[name] = value
        self.weight += _member(name, value)


def measure(value: Value) -> tuple[int, int]:
    """About how many bytes a value takes on the wire, and how deep it is (0: no array or struct).

    Raises `ProtocolError` for `<nil/>`.
    """
    if isinstance(value, str):
        return 35 + len(value), 0
    if isinstance(value, bytes):
        return 35 + len(value) * 4 // 3, 0
    if isinstance(value, list):
        measured = [measure(one) for one in value]
        return 50 + sum(weight for weight, _ in measured), 1 + max(
            (depth for _, depth in measured), default=0
        )
    if isinstance(value, dict):
        measured = [measure(one) for one in value.values()]
        weight = 40 + sum(_NAME_WEIGHT + len(name) for name in value) + sum(weight for weight, _ in measured)
        return weight, 1 + max((depth for _, depth in measured), default=0)
    if value is None:
        raise ProtocolError("a value has <nil/> in it, which neither ROSMaster nor roscpp can send")
    return 45, 0


def _member(name: str, value: Value) -> int:
    return _NAME_WEIGHT + len(name) + measure(value)[0]


def _parts(key: str) -> list[str]:
    return [part for part in key.split("/") if part]


def holds_others(value: Value) -> bool:
    """Whether a value is a namespace with something in it: whose rights are asked, too."""
    return isinstance(value, dict) and bool(value)


def standing_at(tree: Tree, key: str) -> tuple[Value, str | None]:
    """What `key` (canonical) has, None for nothing; and its parent that has a value and is no namespace, if any.

    Such a parent is in the way: ROSMaster replaces it by a namespace when something below it is set.
    """
    node: Value = tree
    passed = ""
    for part in _parts(key):
        if not isinstance(node, dict):
            return None, passed
        node = node.get(part)
        if node is None:
            return None, None
        passed += f"/{part}"
    return node, None


async def get_param(master: "Master", caller: Caller, arguments: tuple[object, ...]) -> Answer:
    """`getParam(caller_id, key)`."""
    key = str(arguments[0])
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
    decision = policy.decide_parameter(request, namespace=holds_others(answer[2]))
    if decision.allowed:
        return None
    return denial_text(decision, master.recorder.decided(caller, method, Category.READ.value, key, decision))


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
    decision = policy.decide_parameter(request, namespace=holds_others(value))
    if not decision.allowed:
        peer = Peer(incarnation.host, str(incarnation.host), incarnation.told)
        caller = Caller(peer, incarnation.name, time.monotonic_ns())
        master.recorder.decided(caller, "paramUpdate", Category.READ.value, key, decision)
    return decision.allowed


async def has_param(master: "Master", caller: Caller, arguments: tuple[object, ...]) -> Answer:
    """`hasParam(caller_id, key)`."""
    return await master.rosmaster.call("hasParam", caller.caller_id, str(arguments[0]))


async def set_param(master: "Master", caller: Caller, arguments: tuple[object, ...]) -> Answer:
    """`setParam(caller_id, key, value)`."""
    key, value = str(arguments[0]), cast(Value, arguments[1])
    master.parameters.check(key, value)
    answer = await master.rosmaster.call("setParam", caller.caller_id, key, value)
    if _is_set(answer, key, value):
        master.parameters.set(key, value)
    return answer


def _is_set(answer: Answer, key: str, value: Value) -> bool:
    """Whether ROSMaster has a value now, by its answer to `setParam`.

    It has it before it looks whom to tell, and answers with an error when that fails (a name with a slash in a
    dictionary, and somebody who subscribed to what it looks like). What it does not take is a root that is none.
    """
    return answer[0] == 1 or key != "/" or isinstance(value, dict)


async def in_order(
    master: "Master", wanted: Sequence[tuple[Caller, str, tuple[object, ...]]]
) -> list[Answer | Exception]:
    """Carry out several calls of `IN_ORDER` one after the other, in few requests: the outcome of each.

    A value is checked as if it came alone after those before it; one that fails holds up no other.
    """
    outcomes: list[Answer | Exception] = []
    waiting: list[Wanted] = []
    weight = 0
    for caller, method, arguments in wanted:
        key, value = str(arguments[0]), cast(tuple[Value, ...], arguments[1:])
        try:
            more = sum(_NAME_WEIGHT + len(key) + measure(one)[0] for one in value)
            if weight + more > _TOGETHER_BYTES or not master.parameters.has_room(weight + more):
                outcomes += await _send(master, waiting)
                waiting, weight = [], 0
            for one in value:
                master.parameters.check(key, one)
        except (ProtocolError, LimitReachedError) as error:
            outcomes += [*await _send(master, waiting), error]
            waiting, weight = [], 0
            continue
        waiting.append((method, (caller.caller_id, key, *value)))
        weight += more
    return outcomes + await _send(master, waiting)


async def _send(master: "Master", calls: list[Wanted]) -> list[Answer | Exception]:
    """Make them, as one call if they are several; the mirror follows what ROSMaster took."""
    outcomes: list[Answer | Exception] = []
    if not calls:
        return outcomes
    try:
        if len(calls) == 1:
            method, params = calls[0]
            outcomes.append(await master.rosmaster.call(method, *params))
        else:
            outcomes += await master.rosmaster.call_in_order(calls)
    except EncodingError as error:
        if len(calls) == 1:
            return [error]
        return [outcome for one in calls for outcome in await _send(master, [one])]  # nothing was sent yet
    except CallFailedError as error:
        return [error] * len(calls)
    for (method, (_caller_id, key, *value)), outcome in zip(calls, outcomes, strict=True):
        if isinstance(outcome, Exception):
            continue
        if method == "setParam" and _is_set(outcome, str(key), value[0]):
            master.parameters.set(str(key), value[0])
        elif method == "deleteParam" and outcome[0] == 1:
            master.parameters.delete(str(key))
    return outcomes


async def delete_param(master: "Master", caller: Caller, arguments: tuple[object, ...]) -> Answer:
    """`deleteParam(caller_id, key)`."""
    key = str(arguments[0])
    answer = await master.rosmaster.call("deleteParam", caller.caller_id, key)
    if answer[0] == 1:
        master.parameters.delete(key)
    return answer


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
    incarnation = await incarnation_of(master, caller, api)
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
