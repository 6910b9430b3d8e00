"""Questions that are asked again, word for word: they get the answer they got before, while that is still right.

Most of what nodes and tools ask is what they asked a moment ago. Each such call has its decision and its record like
any other, but is neither parsed, nor decided, nor written anew where nothing can be different. Invariants:

1. Remembered is only what was allowed and reads what control has itself (`Call.mirrored`); of a multicall, if each part
   does.
2. An answer holds while everything is the same that decision, record and answer are made of: host and words, the policy
   and its revision, who holds the claimed name, the appliance's address that the host is told, and the registry, or the
   value of the parameter.
3. What can refuse a call whatever it asks, or have it wait (an audit log that cannot be written, a disk that is nearly
   full, records that the host owes for) is asked each time; and where the answer waits for its record, nothing is
   answered from here.
4. What is remembered is bounded: so many questions, so many bytes.
"""

import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field

from appliance.audit.record import Repeated
from appliance.master.caller import Caller
from appliance.master.calls.call import Attempt, Table
from appliance.master.calls.gate import Gate
from appliance.master.calls.multicall import MULTICALL
from appliance.master.endpoints.endpoint_addresses import Addresses
from appliance.master.graph.registry import Incarnation, Registry
from appliance.master.parameter_mirror import ParameterMirror
from appliance.master.rosmaster import RosMaster
from appliance.policy.model import Decision
from appliance.policy.policy import Policy
from appliance.rpc.server import HttpRequest, Peer
from appliance.telemetry.audit_trail import AuditTrail
from roswire.errors import PeerError
from roswire.parameter_tree import standing_at
from roswire.xmlrpc import MethodCall, Value

_LARGEST_QUESTION, _LARGEST_ANSWER = 8 << 10, 256 << 10  # bytes of each that are remembered
_MOST_QUESTIONS, _MOST_BYTES = 4096, 16 << 20
State = tuple[int, int, bool]


@dataclass(slots=True)
class _Part:
    """One call: whose it is said to be, who held that name, the parameter and what it had (`key` is empty: none)."""

    caller_id: str
    holder: Incarnation | None
    key: str
    value: Value
    same: Repeated


@dataclass(slots=True)
class _Question:
    """A question whose answer is known, and what that was made of; `call` is its name in the metrics."""

    call: str
    parts: list[_Part]
    answer: bytes
    policy: Policy
    revision: int
    told: str
    seen: State


@dataclass(slots=True)
class Repetitions:
    """What was asked at RVMaster's listener, by host and words."""

    gate: Gate
    registry: Registry
    mirror: ParameterMirror
    rosmaster: RosMaster
    addresses: Addresses
    policy: Callable[[], Policy]
    trail: AuditTrail
    _questions: dict[tuple[str, bytes], _Question | None] = field(default_factory=dict)  # None: asked once
    _bytes: int = 0

    @property
    def state(self) -> State:
        """Registry and parameters, another after every change; and whether ROSMaster is there, and whole."""
        return self.registry.version, self.mirror.version, self.rosmaster.reachable

    def answer(self, request: HttpRequest) -> bytes | None:
        """The answer to a question that was asked before, decided and recorded once more; None for any other."""
        peer = request.peer
        if len(request.body) > _LARGEST_QUESTION:
            return None
        question = self._questions.get((peer.text, request.body))
        if question is None:
            return None
        trail = self.trail
        host = peer.text
        if trail.strict or trail.obstacle or trail.shut_out(host) or trail.owing(host):
            return None
        if not self._holds(question, peer):
            return None
        for part in question.parts:
            trail.decided_again(part.same, request.arrived)
        trail.meter.called(question.call, (time.monotonic_ns() - request.arrived) / 1e9)
        return question.answer

    def _holds(self, question: _Question, peer: Peer) -> bool:
        if (
            question.policy is not self.policy()
            or question.revision != self.trail.revision
            or not self.rosmaster.reachable
            or question.told != self.addresses.told_to(peer)
        ):
            return False
        state = self.state
        if question.seen == state:
            return True
        if not all(self._same(part) for part in question.parts):
            return False
        question.seen = state
        return True

    def _same(self, part: _Part) -> bool:
        """Whether a part holds after a change: if it is about a parameter that has the same value (no namespace)."""
        return (
            part.key != ""
            and self.registry.holder(part.caller_id) is part.holder
            and not isinstance(part.value, dict)
            and standing_at(self.mirror.tree, part.key)[0] is part.value
        )

    def note(
        self, table: Table, request: HttpRequest, call: MethodCall, answer: bytes, *, before: State
    ) -> None:
        """This was answered so, and all was as it is now when it began (`before`); remembered the second time."""
        caller, body = Caller(request.peer, "", request.arrived), request.body
        key = caller.peer.text, body
        if len(body) > _LARGEST_QUESTION or len(answer) > _LARGEST_ANSWER or before != self.state:
            return
        if not self.rosmaster.reachable:
            return
        if key not in self._questions:
            self._put(key, None)
            return
        parts = self._parts(table, caller, call)
        if parts is None:
            return
        told = self.addresses.told_to(caller.peer)
        self._put(
            key, _Question(call.method, parts, answer, self.policy(), self.trail.revision, told, before)
        )

    def _put(self, key: tuple[str, bytes], question: _Question | None) -> None:
        self._bytes += len(key[1]) + (0 if question is None else len(question.answer))
        if len(self._questions) >= _MOST_QUESTIONS or self._bytes > _MOST_BYTES:
            self._questions.clear()
            self._bytes = 0
        self._questions[key] = question

    def _parts(self, table: Table, caller: Caller, call: MethodCall) -> list[_Part] | None:
        """The calls of a question; None if one of them is not to be remembered."""
        calls: Sequence[Value] = [{"methodName": call.method, "params": list(call.params)}]
        if call.method == MULTICALL:
            calls = call.params[0] if call.params and isinstance(call.params[0], list) else []
        parts: list[_Part] = []
        for entry in calls:
            match entry:
                case {"methodName": str(method), "params": list(params)} if (
                    method in table and table[method].call.mirrored
                ):
                    part = self._part(table[method].call.attempt, caller, params)
                    if part is None:
                        return None
                    parts.append(part)
                case _:
                    return None
        return parts

    def _part(
        self, attempt_of: Callable[[Caller, Sequence[Value]], Attempt], caller: Caller, params: list[Value]
    ) -> _Part | None:
        try:
            attempt = attempt_of(caller, params)
        except PeerError:
            return None
        decision = self.gate.decide(attempt, self.mirror.tree)
        if not isinstance(decision, Decision) or decision.word != "allow":
            return None
        request, asker = attempt.request, attempt.caller.asker
        same = self.trail.repeatable(
            asker, attempt.call.name, request.category.value, request.resource, decision, **attempt.about
        )
        value = standing_at(self.mirror.tree, attempt.resource)[0] if attempt.resource else None
        return _Part(asker.caller_id, self.registry.holder(asker.caller_id), attempt.resource, value, same)
