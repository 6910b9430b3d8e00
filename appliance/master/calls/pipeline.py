"""The way of a request, stage by stage: parse → canonicalise → decide → record → perform → answer.

The same stages serve the Master API and the outer faces, with another table of calls. What goes wrong on the way is
an answer of the right shape for the caller, and a record; never an exception for anybody else.
"""

import asyncio
import time
from collections.abc import Callable, Iterator, Mapping
from dataclasses import replace
from typing import TYPE_CHECKING, NamedTuple, cast

import structlog

from appliance.audit.record import Severity
from appliance.master.calls.arguments import KEY, NODE, SEARCH_KEY, SUBGRAPH, canonicalise, check_arity
from appliance.master.calls.call import Answer, Call, Caller, Identity, LimitReachedError, denial_text
from appliance.master.calls.claims import Claims
from appliance.master.calls.gate import Contest, Probe, contested
from appliance.master.calls.parameters import IN_ORDER, asks_for, in_order
from appliance.master.calls.registration import given_up
from appliance.master.calls.write_turns import WriteTurns
from appliance.master.graph.registry import Incarnation
from appliance.master.reach.places import NoPortError
from appliance.policy.model import Address, Category, Decision
from appliance.recorder import NOT_RECORDED
from appliance.ros.errors import EncodingError, LimitExceededError, PeerError, ProtocolError
from appliance.ros.names import check_caller_id, check_tool_id
from appliance.ros.xmlrpc import Limits, MethodCall, Value, build_fault, build_response, parse_call
from appliance.rpc.bulk import Bulk, LargeWrites, bulk_turns, weigh
from appliance.rpc.client import CallFailedError
from appliance.rpc.method_name import method_named
from appliance.rpc.server import Handler, HttpRequest
from appliance.shares.pool import Standing

if TYPE_CHECKING:
    from appliance.master.core import Master

_log = structlog.get_logger()
_MULTICALL = "system.multicall"
FAILURES = (NoPortError, LimitReachedError, PeerError, EncodingError, CallFailedError)
_LONGEST_RUN = 64  # parts of a multicall that reach ROSMaster in one request
_LONGEST_STRETCH = 0.005  # seconds of a multicall without a look at anybody else
_RECORDED = (KEY, SEARCH_KEY, NODE, SUBGRAPH)  # resolved names: short, and what a reviewer asks for
_CLAIM_SHOWN = 1024  # characters of a caller_id that is no name
_FORM = "a part of a multicall has methodName and params, nothing else"
_PARSE_FAULT, _LIMIT_FAULT, _INTERNAL_FAULT = -32700, -32600, -32603


class Pipeline:
    """Serves requests by a table of calls. Bodies and answers over `offload` bytes are read and written in a thread."""

    def __init__(
        self,
        master: "Master",
        *,
        limits: Limits,
        offload: int,
        standing: Callable[[Address], Standing],
    ) -> None:
        self._master = master
        self._limits = limits
        self._offload = offload
        self._claims = Claims()
        self._writes = WriteTurns()
        self._bulk = bulk_turns(standing)
        self._large = LargeWrites(offload, standing)

    def handler(
        self, calls: Mapping[str, Call], *, own: bool = False, target: Incarnation | None = None
    ) -> Handler:
        """The handler of one listener: its table, whether it is for the appliance's own nodes, and its target."""

        async def handle(request: HttpRequest) -> bytes:
            await self._master.addresses.learn(request.peer)
            caller = Caller(request.peer, "", request.arrived, own=own, target=target)
            return await self._serve(calls, caller, request.body)

        return handle

    # --- parse, and write the answer ---

    async def _serve(self, calls: Mapping[str, Call], caller: Caller, body: bytes) -> bytes:
        async with Bulk(self._bulk, caller.peer.host) as bulk:
            try:
                if len(body) <= self._offload:
                    method_call = parse_call(body, self._limits)
                else:
                    method_call = await self._parse_large(body, bulk)
            except PeerError as error:
                return self._not_understood(caller, body, error)
            try:
                answer = await self._answer_all(calls, caller, method_call, bulk)
                known = method_call.method in calls or method_call.method == _MULTICALL
                seconds = (time.monotonic_ns() - caller.arrived) / 1e9
                self._master.recorder.meter.called(method_call.method if known else "unknown", seconds)
                if weigh(answer, self._offload) < self._offload:
                    return build_response(answer)
                await bulk.take()
                return await asyncio.to_thread(build_response, answer)
            except EncodingError as error:
                _log.error("answer cannot be written", call=method_call.method, error=str(error))
                return build_fault(
                    _INTERNAL_FAULT, f"the answer to {method_call.method} cannot be written: {error}"
                )

    async def _parse_large(self, body: bytes, bulk: Bulk) -> MethodCall:
        bulk.large = True
        await bulk.take()
        try:
            return await asyncio.to_thread(parse_call, body, self._limits)
        finally:
            bulk.give_back()  # to carry it out may take long

    def _not_understood(self, caller: Caller, body: bytes, error: PeerError) -> bytes:
        limit = isinstance(error, LimitExceededError)
        decision = self._master.recorder.happened(
            "limit exceeded" if limit else "malformed",
            str(error),
            severity=Severity.WARNING,
            decision="deny",
            host=caller.peer.text,
            category=Category.COMMAND.value,
            resource=method_named(body),
        )
        return build_fault(_LIMIT_FAULT if limit else _PARSE_FAULT, f"{error} [{decision}]")

    # --- one call, or the parts of a multicall ---

    async def _answer_all(
        self, calls: Mapping[str, Call], caller: Caller, call: MethodCall, bulk: Bulk
    ) -> Value:
        if call.method != _MULTICALL or caller.target is not None:
            if self._asks_for_much(call.method, call.params):
                await bulk.take()
            return await self._answer(calls, caller, call.method, call.params, bulk)
        if len(call.params) != 1 or not isinstance(call.params[0], list):
            why = "system.multicall takes one list of calls"
            self._part_refused(caller, why)
            return [-1, why, 0]
        results: list[Value] = []
        room = self._master.parameters.bytes_limit  # as much as one call can be answered
        since = time.monotonic()  # not the loop's time, which stands still meanwhile
        for run in _runs(call.params[0]):
            left = len(call.params[0]) - len(results)
            if room <= 0:
                return results + self._too_much(caller, left)
            if owing := self._master.recorder.owing(caller.peer.text):
                return results + self._beyond(caller, f"{owing}; {left} more parts are not carried out", left)
            # Roslaunch clears and sets parameters in one multicall, and the order is what counts: a run of parameter
            # calls goes to ROSMaster as one, in its order. Everything else waits for the part before it.
            if len(run) > 1:
                results += await self._answer_run(calls, caller, run, bulk)
            else:
                results.append(await self._answer_part(calls, caller, run[0], bulk))
                room -= await self._weigh(results[-1], bulk)
            if time.monotonic() - since > _LONGEST_STRETCH:
                await asyncio.sleep(0)
                since = time.monotonic()
        return results

    def _asks_for_much(self, method: str, params: tuple[Value, ...]) -> bool:
        """Whether the call will be answered with a large tree of parameters."""
        return method == "getParam" and asks_for(self._master.parameters, params, self._offload)

    async def _weigh(self, answer: Value, bulk: Bulk) -> int:
        """About how many bytes an answer has, which is kept until the other parts have theirs."""
        weight = weigh(answer, self._offload)
        if weight < self._offload:
            return weight
        await bulk.take()
        return await asyncio.to_thread(weigh, answer, self._master.parameters.bytes_limit)

    def _too_much(self, caller: Caller, count: int) -> list[Value]:
        """What the parts are answered for which there is no room after the answers to those before them."""
        limit = self._master.parameters.bytes_limit
        why = (
            f"the answers to a multicall have more than {limit} bytes; {count} more parts are not carried out"
        )
        return self._beyond(caller, why, count)

    def _beyond(self, caller: Caller, why: str, count: int) -> list[Value]:
        return [self._multicall_fault(caller, _LIMIT_FAULT, "limit exceeded", why)] * count

    async def _answer_run(
        self, calls: Mapping[str, Call], caller: Caller, run: list[Value], bulk: Bulk
    ) -> list[Value]:
        """Each part is decided and recorded by itself; those that may be carried out are carried out in order."""
        parts: list[_Allowed | Answer | dict[str, Value]] = []
        for part in run:
            call = _part_of(part)
            parts.append(
                self._part_refused(caller, _FORM)
                if call is None
                else await self._first_look(calls, caller, *call, bulk)
            )
        writing = [one for one in parts if isinstance(one, _Allowed) and _writes(one.call)]
        values = [_value(one.arguments) for one in writing]
        async with (
            self._writes.alone([str(one.arguments[0]) for one in writing]),
            self._large.turn(caller.peer.host, values),
        ):
            return await self._carry_out_run(
                [self._judge(one) if isinstance(one, _Allowed) else one for one in parts]
            )

    async def _carry_out_run(self, parts: "list[_Allowed | Answer | dict[str, Value]]") -> list[Value]:
        answers: list[Value] = [None if isinstance(one, _Allowed) else _as_part(one) for one in parts]
        ready = [(place, one) for place, one in enumerate(parts) if isinstance(one, _Allowed)]
        obstacle = await self._obstacle()
        if obstacle is not None:
            for place, allowed in ready:
                answers[place] = [[0, obstacle, allowed.call.denial]]
            return answers
        wanted = [(one.caller, one.call.name, one.arguments) for _place, one in ready]
        outcomes = await in_order(self._master, wanted)
        for (place, one), done in zip(ready, outcomes, strict=True):
            answers[place] = [
                self._failed(one.call, one.caller, done) if isinstance(done, Exception) else done
            ]
        return answers

    async def _answer_part(self, calls: Mapping[str, Call], caller: Caller, part: Value, bulk: Bulk) -> Value:
        if isinstance(part, dict) and part.get("methodName") == _MULTICALL:
            return self._part_refused(caller, "a multicall inside a multicall is not served")
        call = _part_of(part)
        if call is None:
            return self._part_refused(caller, _FORM)
        if self._asks_for_much(*call):
            await bulk.take()
        return [await self._answer(calls, caller, *call, bulk)]

    def _part_refused(self, caller: Caller, why: str) -> dict[str, Value]:
        return self._multicall_fault(caller, _PARSE_FAULT, "malformed", why)

    def _multicall_fault(self, caller: Caller, code: int, event: str, why: str) -> dict[str, Value]:
        """A fault in the place of a part's answer, recorded as this event."""
        record = self._master.recorder.happened(
            event,
            why,
            severity=Severity.WARNING,
            decision="deny",
            host=caller.peer.text,
            category=Category.COMMAND.value,
            resource=_MULTICALL,
        )
        return {"faultCode": code, "faultString": f"{why} [{record}]"}

    async def _answer(
        self, calls: Mapping[str, Call], caller: Caller, method: str, params: tuple[Value, ...], bulk: Bulk
    ) -> Value:
        understood = await self._understand(calls, caller, method, params, bulk)
        if not isinstance(understood, _Allowed):
            return understood
        caller, call, arguments = understood
        if _writes(call) and self._decide(caller, call, arguments).allowed:
            large = self._large.turn(caller.peer.host, [_value(arguments)])
            async with self._writes.alone((str(arguments[0]),)), large:
                return await self._carry_out(caller, call, arguments, self._decide(caller, call, arguments))
        if call.identity is not Identity.NODE or caller.target is not None:
            return await self._carry_out(caller, call, arguments, self._decide(caller, call, arguments))
        probe = await self._probe(caller, call, arguments)
        # Who subscribes to a parameter hears of every write after the value that answers: no write is under way.
        keys = () if call.touches is None or call.resource is None else (str(arguments[call.resource]),)
        async with self._claims.alone(caller.caller_id), self._writes.alone(keys):
            return await self._carry_out(
                caller, call, arguments, self._decide(caller, call, arguments, probe)
            )

    async def _understand(
        self, calls: Mapping[str, Call], caller: Caller, method: str, params: tuple[Value, ...], bulk: Bulk
    ) -> "_Allowed | Answer":
        """The call with its canonical arguments, nothing decided yet; the answer when there is none."""
        call = calls.get(method)
        if call is None:
            return self._unknown(caller, method, params)
        try:
            if bulk.large and weigh(list(params), self._offload) >= self._offload:
                return _Allowed(*await asyncio.to_thread(_canonical, call, caller, params))
            return _Allowed(*_canonical(call, caller, params))
        except PeerError as error:
            return self._malformed(call, caller, params, error)

    async def _first_look(
        self, calls: Mapping[str, Call], caller: Caller, method: str, params: tuple[Value, ...], bulk: Bulk
    ) -> "_Allowed | Answer":
        """Understood, and not denied as things are; else the answer. The call is decided when it is its turn."""
        understood = await self._understand(calls, caller, method, params, bulk)
        if isinstance(understood, _Allowed) and not self._decide(*understood).allowed:
            return self._judge(understood)
        return understood

    def _judge(self, understood: "_Allowed") -> "_Allowed | Answer":
        """Decided and recorded: the same when it may be carried out, or the answer."""
        decision = self._decide(*understood)
        record = self._record(*understood, decision)
        return understood if decision.allowed else [0, self._told(decision, record), understood.call.denial]

    async def _carry_out(
        self, caller: Caller, call: Call, arguments: tuple[object, ...], decision: Decision
    ) -> Value:
        policy = self._master.policy()
        record = self._record(caller, call, arguments, decision)
        if not decision.allowed:
            given_up(self._master, caller, call, arguments)
        obstacle = await self._obstacle()
        if obstacle is not None:
            return [0, obstacle, call.denial]
        if not decision.allowed:
            return [0, self._told(decision, record), call.denial]
        answer = await self._perform(call, caller, arguments)
        lasts = call.identity is Identity.NODE or call.category is Category.CALL
        if lasts and self._master.policy() is not policy:
            # It has waited: what it left may be allowed no longer.
            self._master.redecide_for(caller.peer.host, caller.caller_id)
        return answer

    def _record(self, caller: Caller, call: Call, arguments: tuple[object, ...], decision: Decision) -> str:
        asked = self._master.gate.asked(caller, call, arguments)
        asked_of = what_about(call, arguments)
        return self._master.recorder.decided(
            caller.asker,
            call.name,
            asked.category.value,
            asked.resource,
            decision,
            reads=call.reads and asked.category is Category.COMMAND,
            **asked_of,
        )

    async def _obstacle(self) -> str | None:
        """What a caller is told when its record must be on disk before the answer, and cannot be."""
        recorder = self._master.recorder
        if not recorder.strict or await recorder.durable() is None:
            return None
        return f"denied: {NOT_RECORDED}"

    async def _probe(self, caller: Caller, call: Call, arguments: tuple[object, ...]) -> Probe | None:
        """What is known now of the node that holds the name the caller wants, if another host's does."""
        outcome = self._master.gate.decide(caller, call, arguments, self._master.parameters.tree)
        return await self._master.liveness.probe(outcome.holder) if isinstance(outcome, Contest) else None

    def _decide(
        self, caller: Caller, call: Call, arguments: tuple[object, ...], probe: Probe | None = None
    ) -> Decision:
        recorder = self._master.recorder
        obstacle = recorder.obstacle or ("" if caller.own else recorder.shut_out(caller.peer.text))
        if obstacle:
            return Decision(False, None, obstacle)
        outcome = self._master.gate.decide(caller, call, arguments, self._master.parameters.tree)
        return contested(outcome, probe) if isinstance(outcome, Contest) else outcome

    async def _perform(self, call: Call, caller: Caller, arguments: tuple[object, ...]) -> Value:
        try:
            return await call.perform(self._master, caller, arguments)
        except FAILURES as error:
            return self._failed(call, caller, error)

    def _failed(self, call: Call, caller: Caller, error: Exception) -> Answer:
        """The answer to a call that was allowed and could not be carried out."""
        claimed = (caller.caller_id,)
        match error:
            case NoPortError() | LimitReachedError():
                record = self._master.recorder.happened(
                    "limit exceeded",
                    str(error),
                    severity=Severity.ALARM,
                    decision="deny",
                    host=caller.peer.text,
                    caller_id=caller.caller_id,
                    category=call.category.value,
                    resource=call.name,
                    call=call.name,
                )
                return [0, f"{error} [{record}]", call.denial]
            case PeerError():
                return self._malformed(call, caller, claimed, error)
            case EncodingError():
                return self._malformed(call, caller, claimed, ProtocolError(f"cannot be passed on: {error}"))
            case CallFailedError():
                # The text names the hidden ROSMaster's address: it is for our log, not for a node.
                _log.error("call failed", call=call.name, caller_id=caller.caller_id, error=str(error))
                return [0, "the ROS Master does not answer; the appliance is bringing it back", call.denial]
        raise error

    def _told(self, decision: Decision, record: str) -> str:
        return denial_text(decision, record, self._master.policy().tell)

    def _unknown(self, caller: Caller, method: str, params: tuple[Value, ...]) -> Answer:
        claimed = claimed_name(params)
        caller = replace(caller, caller_id=claimed)
        decision = Decision(False, None, f"{method[:200]!r} is not a call that is served here")
        record = self._master.recorder.decided(
            caller.asker, method, Category.COMMAND.value, method[:200], decision
        )
        return [0, self._told(decision, record), 0]

    def _malformed(self, call: Call, caller: Caller, params: tuple[Value, ...], error: PeerError) -> Answer:
        claimed = claimed_name(params)
        self._master.recorder.happened(
            "malformed",
            str(error),
            severity=Severity.WARNING,
            decision="deny",
            host=caller.peer.text,
            caller_id=claimed,
            category=call.category.value,
            resource=call.name,
            call=call.name,
        )
        return [-1, str(error), call.denial]


class _Allowed(NamedTuple):
    """A call that is understood (of `_judge`: and may be carried out), with its canonical arguments."""

    caller: Caller
    call: Call
    arguments: tuple[object, ...]


def _part_of(part: Value) -> tuple[str, tuple[Value, ...]] | None:
    """Method and parameters of a part of a multicall; None when it does not have its form."""
    match part:
        case {"methodName": str(method), "params": list(params), **rest} if not rest:
            return method, tuple(params)
    return None


def _runs(parts: list[Value]) -> Iterator[list[Value]]:
    """The parts of a multicall in their order: runs of parameter calls, and each other part by itself."""
    run: list[Value] = []
    for part in parts:
        together = isinstance(part, dict) and part.get("methodName") in IN_ORDER
        if run and (not together or len(run) >= _LONGEST_RUN):
            yield run
            run = []
        if together:
            run.append(part)
        else:
            yield [part]
    if run:
        yield run


def _writes(call: Call) -> bool:
    """Whether the call, whose first parameter is then the key, changes a parameter."""
    return call.touches is Category.WRITE


def _value(arguments: tuple[object, ...]) -> Value:
    """The value that a call which changes a parameter brings; None for a call that takes one away."""
    return cast(Value, arguments[1]) if len(arguments) > 1 else None


def _as_part(answer: "Answer | dict[str, Value]") -> Value:
    """An answer, or a fault, as it stands in the answer to a multicall."""
    return answer if isinstance(answer, dict) else [answer]


def _canonical(
    call: Call, caller: Caller, params: tuple[Value, ...]
) -> tuple[Caller, Call, tuple[object, ...]]:
    caller_id, arguments = canonical_call(call, params)
    return replace(caller, caller_id=caller_id), call, arguments


def canonical_call(call: Call, params: tuple[Value, ...]) -> tuple[str, tuple[object, ...]]:
    """The name that a call claims, and its canonical arguments. Raises `PeerError`."""
    if call.identity is Identity.NOBODY:
        return "", canonicalise(call.parameters, "", params)
    if not params:
        raise ProtocolError("missing required caller_id parameter")
    check_arity(call.parameters, params[1:])
    caller_id = params[0]
    if not isinstance(caller_id, str):
        raise ProtocolError("caller_id must be a string")
    if call.identity is Identity.NODE:
        check_caller_id(caller_id)
    elif caller_id or not call.reads:
        check_tool_id(caller_id)
    return caller_id, canonicalise(call.parameters, caller_id, params[1:])


def what_about(call: Call, arguments: tuple[object, ...]) -> dict[str, str]:
    """What a command is about (a parameter's key, a node's name), for the record: its resource is the command."""
    if call.category is not Category.COMMAND:
        return {}
    return {
        parameter.name: str(value)
        for parameter, value in zip(call.parameters, arguments, strict=False)
        if parameter in _RECORDED
    }


def claimed_name(params: tuple[Value, ...]) -> str:
    """Whom a call that is not understood says it is from, for the record."""
    return params[0][:_CLAIM_SHOWN] if params and isinstance(params[0], str) else ""
