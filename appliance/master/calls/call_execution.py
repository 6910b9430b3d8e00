"""Carry out a call, from its parameters to its answer: canonicalise → decide → record → perform.

1. A registering call waits for earlier ones of the same name, so two hosts cannot register a free name at the same
   time. A write of a parameter waits for earlier writes of overlapping keys, which could change the tree that the
   decision depends on. Other calls take no turn.
2. A call that had to wait is decided again in its turn. If it did not wait, no other code ran after its decision.
3. If a new policy comes into force while a call is carried out, the caller's rights are decided again afterwards,
   because the revocation did not see the result of the call.
4. An error becomes a record and a well-formed answer, never an exception.
"""

import asyncio
import contextlib
from collections.abc import AsyncIterator, Callable, Collection, Sequence
from dataclasses import dataclass, field
from typing import NamedTuple

import structlog

from appliance.audit.log.record import Severity
from appliance.master.calls.call import (
    Attempt,
    Caller,
    CallVerb,
    NotServedError,
    RosCall,
    Table,
    claimed_name,
    denial_text,
    with_record,
)
from appliance.master.calls.gate import CallGate, NameConflict, decide_contest
from appliance.master.calls.parameter_calls import ParameterCalls, ParameterWrite
from appliance.master.calls.registration import given_up
from appliance.master.endpoints.node_ports import NoPortError
from appliance.master.graph.registry import HostFullError, Kind, Registry
from appliance.master.parameter_charges import LimitReachedError
from appliance.master.reconcile.liveness import Liveness, Probe
from appliance.master.rosmaster import Answer
from appliance.policy.model import Address, CallHold, Category, Decision, Request
from appliance.policy.policy import Policy
from appliance.rpc.fair_queue import Bulk, LargeWrites, weigh
from appliance.rpc.xmlrpc_client import CallFailedError
from appliance.store.writer_thread import StoreError
from appliance.telemetry.audit_trail import NOT_RECORDED, AuditTrail
from roswire.errors import EncodingError, PeerError, ProtocolError
from roswire.xmlrpc import Value

_log = structlog.get_logger()
_REGISTERS = (CallVerb.REGISTER, CallVerb.UNREGISTER)
_FAILURES = (
    HostFullError, NoPortError, NotServedError, LimitReachedError, PeerError, EncodingError, CallFailedError,
    StoreError,
)  # fmt: skip


class KeyTurns:
    """The turns of running and waiting calls, in order of arrival. Keys are canonical."""

    def __init__(self) -> None:
        self._turns: dict[KeyTurn, None] = {}

    def __len__(self) -> int:
        return len(self._turns)

    def alone(self, keys: Collection[str]) -> "KeyTurn":
        """Return a turn, which waits for earlier calls with equal or overlapping keys."""
        return KeyTurn(self._turns, _ended(keys))

    def of_name(self, name: str) -> "KeyTurn":
        return self.alone([name.replace("/", ".")])


class KeyTurn:
    """The turn of a call. If it need not wait, entering it does not switch tasks, so its decision stays valid."""

    __slots__ = ("_done", "_keys", "_turns")

    def __init__(self, turns: "dict[KeyTurn, None]", keys: tuple[str, ...]) -> None:
        self._turns = turns
        self._keys = keys
        self._done: asyncio.Event | None = None  # made when another call waits for this call

    async def __aenter__(self) -> bool:
        before = [turn for turn in self._turns if _meet(self._keys, turn._keys)]
        self._turns[self] = None
        try:
            for turn in before:
                await turn.done_event().wait()
        except BaseException:
            self._end()
            raise
        return bool(before)

    async def __aexit__(self, *_error: object) -> None:
        self._end()

    def done_event(self) -> asyncio.Event:
        if self._done is None:
            self._done = asyncio.Event()
            if self not in self._turns:
                self._done.set()
        return self._done

    def _end(self) -> None:
        del self._turns[self]
        if self._done is not None:
            self._done.set()


def touch(keys: Collection[str], others: Collection[str]) -> bool:
    return _meet(_ended(keys), _ended(others))


def _ended(keys: Collection[str]) -> tuple[str, ...]:
    return tuple({key if key == "/" else f"{key}/" for key in keys})


def _meet(mine: tuple[str, ...], others: tuple[str, ...]) -> bool:
    return any(key.startswith(others) for key in mine) or any(other.startswith(mine) for other in others)


class ServedRequest(NamedTuple):
    """A request, and the table of calls of its listener; `bulk` holds its turn for large values."""

    table: Table
    caller: Caller
    bulk: Bulk


@dataclass(frozen=True, kw_only=True)
class Execution:
    """Carries out calls. A write of at least `large` bytes waits for other large writes.

    `hold_call(request)` holds a call that needs an approval, and returns the answer to its host.
    """

    gate: CallGate
    policy: Callable[[], Policy]
    trail: AuditTrail
    registry: Registry
    flush: Callable[[], None]
    liveness: Liveness
    parameters: ParameterCalls
    redecide_for: Callable[[Address, str], None]
    hold_call: Callable[[Request], CallHold]
    large: int
    large_writes: LargeWrites
    _names: KeyTurns = field(default_factory=KeyTurns, init=False)
    _writes: KeyTurns = field(default_factory=KeyTurns, init=False)

    async def understand(
        self, visit: ServedRequest, method: str, params: Sequence[Value]
    ) -> Attempt | Answer:
        if method not in visit.table:
            return self._unknown(visit.caller, method, params)
        call = visit.table[method].call
        try:
            if visit.bulk.large and weigh(list(params), self.large) >= self.large:
                return await visit.bulk.in_thread(call.attempt, visit.caller, params)
            return call.attempt(visit.caller, params)
        except PeerError as error:
            return self._malformed(call, visit.caller._replace(caller_id=claimed_name(params)), error)

    async def answer(self, visit: ServedRequest, attempt: Attempt) -> Value:
        if attempt.call.tells and self.parameters.weight_of_answer(attempt) >= self.large:
            await visit.bulk.take()
        call, probe = attempt.call, None
        registers, writes = call.verb in _REGISTERS, call.verb is CallVerb.WRITE
        outcome = self._decide(attempt)
        if isinstance(outcome, NameConflict):  # only for registering calls
            probe = await self.liveness.probe(outcome.holder)
        elif not outcome.allowed or not (registers or writes):
            return await self._carry_out(visit, attempt, outcome)
        elif writes:
            return await self._in_turn(visit, attempt, outcome)
        async with self._names.of_name(attempt.caller.caller_id) as later:
            if later or isinstance(outcome, NameConflict):
                outcome = self._settle(attempt, probe)
            if call.kind is Kind.PARAMETER:
                return await self._in_turn(visit, attempt, outcome)
            return await self._carry_out(visit, attempt, outcome)

    async def _in_turn(self, visit: ServedRequest, attempt: Attempt, outcome: Decision) -> Value:
        async with self._turn([attempt]) as later:
            if later:
                outcome = self._settle(attempt)
            return await self._carry_out(visit, attempt, outcome)

    async def answer_run(self, visit: ServedRequest, run: Sequence[Attempt], weight: int) -> list[Value]:
        """Decide reads and writes of parameters one by one, and carry them out as if in order.

        No read depends on an earlier write of the run, so all reads are carried out first. Their answers have about
        `weight` bytes.
        """
        if weight >= self.large:
            await visit.bulk.take()
        looks = [self._settle(attempt) for attempt in run]
        writing = [
            attempt
            for attempt, look in zip(run, looks, strict=True)
            if look.allowed and attempt.call.verb is CallVerb.WRITE
        ]
        if not writing:
            return await self._carry_out_run(visit, run, looks)
        async with self._turn(writing) as later:
            if later:
                looks = [
                    self._settle(attempt) if look.allowed else look
                    for attempt, look in zip(run, looks, strict=True)
                ]
            return await self._carry_out_run(visit, run, looks)

    @contextlib.asynccontextmanager
    async def _turn(self, attempts: Sequence[Attempt]) -> AsyncIterator[bool]:
        """Wait until no other call writes these parameters; yield whether other code may have run.

        A subscription also takes a turn, so its node misses no write after the value in the answer. The wait for the
        ROS master comes before the decision that counts.
        """
        keys = [attempt.resource for attempt in attempts if attempt.call.kind is Kind.PARAMETER]
        host, values = attempts[0].caller.peer.host, [attempt.value for attempt in attempts]
        async with self._writes.alone(keys) as later, self.large_writes.turn(host, values) as large:
            yield await self.parameters.rosmaster.wait() or later or large

    async def _carry_out(self, visit: ServedRequest, attempt: Attempt, decision: Decision) -> Value:
        policy, verb = self.policy(), attempt.call.verb
        denied = self._record(attempt, decision)
        if denied is not None and verb is CallVerb.UNREGISTER:
            given_up(self.registry, attempt)
            self.flush()
        obstacle = await self._obstacle() if self.trail.strict else None
        if obstacle is not None:
            return [0, obstacle, attempt.call.denial]
        if denied is not None:
            return denied
        answer = await self._perform(visit, attempt)
        if verb in {CallVerb.REGISTER, CallVerb.CONNECT} and self.policy() is not policy:
            self.redecide_for(attempt.caller.peer.host, attempt.caller.caller_id)
        return answer

    async def _carry_out_run(
        self, visit: ServedRequest, run: Sequence[Attempt], decisions: Sequence[Decision]
    ) -> list[Value]:
        policy, version = self.policy(), self.registry.version
        answers: list[Value] = [
            self._record(attempt, decision) for attempt, decision in zip(run, decisions, strict=True)
        ]
        obstacle = await self._obstacle() if self.trail.strict else None
        writes: list[int] = []
        for place, (attempt, denied) in enumerate(zip(run, answers, strict=True)):
            if denied is not None:
                continue
            if obstacle is not None:
                answers[place] = [0, obstacle, attempt.call.denial]
            elif attempt.call.verb is CallVerb.WRITE:
                writes.append(place)
            else:
                answers[place] = await self._perform(visit, attempt)
        wanted = [run[place] for place in writes]
        outcomes: Sequence[Value | Exception]
        stands = self.policy() is policy and not self.trail.obstacle
        if stands and self.registry.version != version:  # another host may now hold the caller's name
            stands = all(self._settle(one).allowed for one in wanted)
        if not wanted or stands:
            outcomes = await self.parameters.write(
                [ParameterWrite(one.caller, one.resource, one.value) for one in wanted]
            )
        else:  # policy or registry changed while a read waited for the ROS master, or a record for the disk
            looks = [self._settle(one) for one in wanted]
            outcomes = await self._carry_out_run(visit, wanted, looks)
        for place, outcome in zip(writes, outcomes, strict=True):
            answers[place] = self._failed(run[place], outcome) if isinstance(outcome, Exception) else outcome
        return answers

    # --- decide and record ---

    def _decide(self, attempt: Attempt) -> Decision | NameConflict:
        caller = attempt.caller
        obstacle = self.trail.obstacle or ("" if caller.own else self.trail.shut_out(caller.peer.text))
        if obstacle:
            return Decision(False, None, obstacle)
        return self.gate.decide(attempt, self.parameters.mirror.tree)

    def _settle(self, attempt: Attempt, probe: Probe | None = None) -> Decision:
        outcome = self._decide(attempt)
        return decide_contest(outcome, probe) if isinstance(outcome, NameConflict) else outcome

    def _record(self, attempt: Attempt, decision: Decision) -> Answer | None:
        request, call = attempt.request, attempt.call
        if decision.asks is not None and not decision.allowed:
            decision = self.hold_call(decision.asks).of(decision)
        record = self.trail.decided(
            attempt.caller.asker,
            call.name,
            request.category.value,
            request.resource,
            decision,
            reads=call.verb is CallVerb.READ and request.category is Category.COMMAND,
            **attempt.about,
        )
        return None if decision.allowed else [0, self._denial_text(decision, record), call.denial]

    async def _obstacle(self) -> str | None:
        if await self.trail.durable() is None:
            return None
        return f"denied: {NOT_RECORDED}"

    def _denial_text(self, decision: Decision, record: str) -> str:
        return denial_text(decision, record, self.policy().tell)

    # --- perform, and what can go wrong ---

    async def _perform(self, visit: ServedRequest, attempt: Attempt) -> Value:
        call, part = visit.table[attempt.call.name]
        try:
            answer = await call.method.perform(part, attempt.caller, *attempt.arguments)
            self.flush()
            return answer
        except _FAILURES as error:
            return self._failed(attempt, error)

    def _failed(self, attempt: Attempt, error: Exception) -> Answer:
        caller, call = attempt.caller, attempt.call
        match error:
            case HostFullError() | NoPortError() | LimitReachedError():
                record = self.trail.happened(
                    "limit exceeded",
                    str(error),
                    severity=Severity.ALARM,
                    decision="deny",
                    host=caller.peer.text,
                    caller_id=caller.caller_id,
                    category=call.row.category.value,
                    resource=call.name,
                    call=call.name,
                )
                return [0, with_record(str(error), record), call.denial]
            case NotServedError() | StoreError():
                decision = Decision(False, None, str(error))
                return self._record(attempt, decision) or [0, str(error), call.denial]
            case PeerError():
                return self._malformed(call, caller, error)
            case EncodingError():
                return self._malformed(call, caller, ProtocolError(f"cannot be forwarded: {error}"))
            case CallFailedError():
                # The text contains the ROS master's address, so it is only logged.
                _log.error("call failed", call=call.name, caller_id=caller.caller_id, error=str(error))
                return [0, "the ROS master does not answer; the appliance is restarting it", call.denial]
        raise error

    def _unknown(self, caller: Caller, method: str, params: Sequence[Value]) -> Answer:
        caller = caller._replace(caller_id=claimed_name(params))
        decision = Decision(False, None, f"{method[:200]!r} is not a call that is served here")
        record = self.trail.decided(caller.asker, method, Category.COMMAND.value, method[:200], decision)
        return [0, self._denial_text(decision, record), 0]

    def _malformed(self, call: RosCall[object], caller: Caller, error: PeerError) -> Answer:
        self.trail.happened(
            "malformed",
            str(error),
            decision="deny",
            host=caller.peer.text,
            caller_id=caller.caller_id,
            category=call.row.category.value,
            resource=call.name,
            call=call.name,
        )
        return [-1, str(error), call.denial]
