"""Carry out the parameter calls. The mirror answers most reads, because a starting node makes hundreds.

`searchParam` must not reveal the existence of unreadable parameters: a global key is decided before the search, and a
search upwards skips unreadable keys. If nothing is found, the answer depends only on the policy.

Parameters in answers and updates are checked again: they may contain more than the decision on the call covered.
"""

import asyncio
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import NamedTuple

from appliance.base import clock
from appliance.master.calls.call import Attempt, Caller, denial_text
from appliance.master.graph.registry import Incarnation
from appliance.master.parameter_charges import APPLIANCE, NAME_WEIGHT, LimitReachedError, measure
from appliance.master.parameter_mirror import ParameterMirror, Reservation
from appliance.master.reconcile.subscribers import settled
from appliance.master.rosmaster import Answer, RosMaster, Wanted
from appliance.policy.model import Address, Category, Decision, Request
from appliance.policy.policy import Policy
from appliance.policy.rights import decide_right, right_to_find, right_to_read
from appliance.rpc.fair_queue import weigh
from appliance.rpc.server import Peer
from appliance.rpc.xmlrpc_client import CallFailedError
from appliance.telemetry.audit_trail import AuditTrail
from roswire.errors import EncodingError, ProtocolError
from roswire.names import candidate_keys
from roswire.parameter_tree import names_in, standing_at
from roswire.xmlrpc import Value

_SEARCH = "searchParam"
_NAMES_AT_ONCE = 500  # the names that are decided without a pause: a few milliseconds
_TOGETHER_BYTES = 256 << 10  # the most bytes of values in one request to the ROS master


@dataclass(frozen=True, slots=True)
class ParameterRights:
    """Checks parameters by the policy in force, and records denials."""

    policy: Callable[[], Policy]
    trail: AuditTrail

    def denial_to_read(self, caller: Caller, call: str, key: str, answer: Answer) -> str | None:
        """Return a denial text if the caller may not read the answer's value.

        The decision on the call used an earlier state of the parameters.
        """
        if answer[0] != 1 or not isinstance(answer[2], dict) or caller.own:
            return None
        decision = self._to_read(caller.peer.host, caller.caller_id, key, answer[2])
        return None if decision.allowed else self.record_denial(caller, call, key, decision)

    def may_read_value(self, incarnation: Incarnation, key: str, value: Value) -> bool:
        """Return whether a subscriber may read a new value (an empty namespace if it was deleted); record a denial."""
        if incarnation.own:
            return True
        decision = self._to_read(incarnation.host, incarnation.name, key, value)
        if not decision.allowed:
            peer = Peer(incarnation.host, str(incarnation.host), incarnation.told)
            self.record_denial(Caller(peer, incarnation.name, clock.now_ns()), "paramUpdate", key, decision)
        return decision.allowed

    def may_know_value(self, incarnation: Incarnation, key: str, value: Value) -> bool:
        return incarnation.own or self._to_read(incarnation.host, incarnation.name, key, value).allowed

    def to_find(self, caller: Caller, key: str) -> Decision:
        request = Request(caller.peer.host, caller.caller_id, Category.READ, key)
        return decide_right(self.policy(), right_to_find(request))

    def record_denial(self, caller: Caller, call: str, key: str, decision: Decision) -> str:
        record = self.trail.decided(caller.asker, call, Category.READ.value, key, decision)
        return denial_text(decision, record, self.policy().tell)

    def _to_read(self, host: Address, caller_id: str, key: str, value: Value) -> Decision:
        request = Request(host, caller_id, Category.READ, key)
        return decide_right(self.policy(), right_to_read(request, value))


class ParameterWrite(NamedTuple):
    """A write of a parameter; a `value` of None deletes it."""

    caller: Caller
    key: str
    value: Value


@dataclass(frozen=True, slots=True)
class ParameterCalls:
    """The parameter calls. The ROS master answers reads of at least `large` bytes, and `searchParam`."""

    rosmaster: RosMaster
    mirror: ParameterMirror
    changed: Callable[[str, Value, str | None, Value], None]
    rights: ParameterRights
    large: int

    async def get_param(self, caller: Caller, key: str) -> Answer:
        """`getParam(caller_id, key)`."""
        answer = await self.read(caller, key)
        hidden = self.rights.denial_to_read(caller, "getParam", key, answer)
        return answer if hidden is None else [0, hidden, 0]

    async def read(self, caller: Caller, key: str) -> Answer:
        there, _ = standing_at(self.mirror.tree, key)
        if not self.rosmaster.reachable or (
            isinstance(there, dict) and weigh(there, self.large) >= self.large
        ):
            return await self.rosmaster.call("getParam", caller.caller_id, key)
        if there is None:
            return [-1, f"Parameter [{key}] is not set", 0]
        return [1, f"Parameter [{key}]", settled(there)]

    async def has_param(self, caller: Caller, key: str) -> Answer:
        """`hasParam(caller_id, key)`."""
        if self.rosmaster.reachable:
            return [1, key, standing_at(self.mirror.tree, key)[0] is not None]
        return await self.rosmaster.call("hasParam", caller.caller_id, key)

    async def set_param(self, caller: Caller, key: str, value: Value) -> Answer:
        """`setParam(caller_id, key, value)`."""
        return await self._write_one(ParameterWrite(caller, key, value))

    async def delete_param(self, caller: Caller, key: str) -> Answer:
        """`deleteParam(caller_id, key)`."""
        return await self._write_one(ParameterWrite(caller, key, None))

    async def get_param_names(self, caller: Caller) -> Answer:
        """`getParamNames(caller_id)` → the names of the parameters that the host may read."""
        if self.rosmaster.reachable and self.mirror.weight < self.large:
            answer: Answer = [1, "Parameter names", list(names_in(self.mirror.tree))]
        else:
            answer = await self.rosmaster.call("getParamNames", caller.caller_id)
        if answer[0] == 1 and isinstance(answer[2], list) and not caller.own:
            names, answer[2] = answer[2], (found := [])
            for begin in range(0, len(names), _NAMES_AT_ONCE):
                if begin:
                    await asyncio.sleep(0)  # deciding many names takes time, so other hosts have a turn
                some = names[begin : begin + _NAMES_AT_ONCE]
                found += [name for name in some if self.rights.to_find(caller, str(name)).allowed]
        return answer

    async def search_param(self, caller: Caller, key: str) -> Answer:
        """`searchParam(caller_id, key)` → the name that is found, which the host may read."""
        if caller.own or not caller.caller_id:
            return await self.rosmaster.call(_SEARCH, caller.caller_id, key)
        places = {name: self.rights.to_find(caller, name) for name in candidate_keys(key, caller.caller_id)}
        hidden = [name for name, decision in places.items() if not decision.allowed]
        if key.startswith("/") and hidden:
            return [0, self.rights.record_denial(caller, _SEARCH, hidden[0], places[hidden[0]]), ""]
        answer = await self.rosmaster.call(_SEARCH, caller.caller_id, key)
        found = _found(answer)
        if found in hidden:
            found = self._next_readable(key, places, found)
            answer = [1, f"Found [{found}]", found] if found is not None else [-1, "", ""]
        if found is not None and places[found].would_deny:
            self.rights.record_denial(caller, _SEARCH, found, places[found])
        if answer[0] != 1 and hidden:
            why = self.rights.record_denial(caller, _SEARCH, hidden[0], places[hidden[0]])
            return [-1, f"Cannot find parameter [{key}] in an upwards search of readable ones: {why}", ""]
        return answer

    def _next_readable(self, key: str, places: dict[str, Decision], hidden: str) -> str | None:
        """Return the name that the search would have found if unreadable parameters did not exist."""
        levels = len([part for part in key.split("/") if part])
        names = list(places)
        for name in names[names.index(hidden) + 1 :]:
            # As in the ROS master, only the first part of the key must exist.
            first = "/".join(name.split("/")[: -levels + 1 or None])
            if places[name].allowed and standing_at(self.mirror.tree, first)[0] is not None:
                return name
        return None

    def weight_of_answer(self, attempt: Attempt) -> int:
        if not attempt.call.tells:
            return 0
        return weigh(standing_at(self.mirror.tree, attempt.resource)[0], self.large)

    async def _write_one(self, write: ParameterWrite) -> Answer:
        [outcome] = await self.write([write])
        if isinstance(outcome, Exception):
            raise outcome
        return outcome

    async def write(self, writes: Sequence[ParameterWrite]) -> list[Answer | Exception]:
        """Carry out writes in order; a failed write does not affect others.

        Each value is checked as if it were sent after the earlier values.
        """
        outcomes: list[Answer | Exception] = []
        waiting: list[tuple[ParameterWrite, Reservation | None]] = []
        weight = 0
        for write in writes:
            try:
                measured, depth = (0, 0) if write.value is None else measure(write.value)
                self.mirror.check(write.key, depth)
                if weight + measured + len(write.key) > _TOGETHER_BYTES:
                    outcomes += await self._send(waiting)
                    waiting, weight = [], 0
                try:
                    reserved = self._reserve(write, measured)
                except LimitReachedError:  # earlier writes may free room, so send them first
                    outcomes += await self._send(waiting)
                    waiting, weight = [], 0
                    reserved = self._reserve(write, measured)
            except (ProtocolError, LimitReachedError) as error:
                outcomes += [*await self._send(waiting), error]
                waiting, weight = [], 0
                continue
            waiting.append((write, reserved))
            weight += NAME_WEIGHT + len(write.key) + measured
        return outcomes + await self._send(waiting)

    def _reserve(self, write: ParameterWrite, weight: int) -> Reservation | None:
        if write.value is None:
            return None
        host: Address = APPLIANCE if write.caller.own else write.caller.peer.host
        return self.mirror.reserve(write.key, weight, host)

    async def _send(
        self, waiting: list[tuple[ParameterWrite, Reservation | None]]
    ) -> list[Answer | Exception]:
        try:
            outcomes = await self._call_rosmaster([_wanted(write) for write, _reserve in waiting])
        finally:
            for _write, reserved in waiting:
                if reserved is not None:
                    reserved.release()
        with self.mirror.together():
            for (write, reserved), outcome in zip(waiting, outcomes, strict=True):
                if not isinstance(outcome, Exception):
                    self._written(write, reserved, outcome)
        return outcomes

    def _written(self, write: ParameterWrite, reserved: Reservation | None, outcome: Answer) -> None:
        before, _ = standing_at(self.mirror.tree, write.key)
        if reserved is not None and _is_set(outcome, write):
            self.mirror.set(write.key, write.value, reserved)
            self.changed(write.key, write.value, write.caller.caller_id, before)
        elif reserved is None and outcome[0] == 1:
            self.mirror.delete(write.key)
            self.changed(write.key, {}, None, before)

    async def _call_rosmaster(self, calls: list[Wanted]) -> list[Answer | Exception]:
        if not calls:
            return []
        try:
            if len(calls) == 1:
                method, params = calls[0]
                return [await self.rosmaster.call(method, *params)]
            return list[Answer | Exception](await self.rosmaster.call_in_order(calls))
        except EncodingError as error:
            if len(calls) == 1:
                return [error]
            return [
                outcome for call in calls for outcome in await self._call_rosmaster([call])
            ]  # nothing was sent yet
        except CallFailedError as error:
            return [error] * len(calls)


def _wanted(write: ParameterWrite) -> Wanted:
    if write.value is None:
        return "deleteParam", (write.caller.caller_id, write.key)
    return "setParam", (write.caller.caller_id, write.key, write.value)


def _is_set(answer: Answer, write: ParameterWrite) -> bool:
    """Return whether the ROS master has stored the value.

    It stores a value before it computes the updates for subscribers, so it may store the value and still answer with
    an error (for a name such as `a/b` in a dictionary). It rejects only a root that is not a namespace.
    """
    return answer[0] == 1 or write.key != "/" or isinstance(write.value, dict)


def _found(answer: Answer) -> str | None:
    if answer[0] != 1 or not isinstance(answer[2], str):
        return None
    return "/" + "/".join(part for part in answer[2].split("/") if part)
