"""`system.multicall`: the parts are answered in their order, and a part that fails holds up no other.

Roslaunch clears and sets parameters in one multicall, and the order is what counts. Calls that read and write
parameters and follow each other are a *run*: each is decided and recorded by itself, they wait for the disk and for
ROSMaster once. A read of what a run writes begins the next. Every run, and every other part, waits for the one before
it; after each, other hosts may have their turn.
"""

import asyncio
from collections import deque
from collections.abc import Iterable
from dataclasses import dataclass, field

from appliance.master.calls.call import Attempt, Verb, with_record
from appliance.master.calls.call_execution import Execution, Visit
from appliance.master.calls.call_order import touch
from appliance.master.calls.parameter_calls import ParameterCalls
from appliance.policy.model import Category
from appliance.rpc.bulk import weigh
from appliance.telemetry.audit_trail import AuditTrail
from roswire.xmlrpc import Value

MULTICALL = "system.multicall"
PARSE_FAULT, LIMIT_FAULT = -32700, -32600
_LONGEST_RUN = 64  # parts that reach ROSMaster in one request
_LONGEST_READING = 8  # parts of a run that reads: each is answered before others have their turn
_FORM = "a part of a multicall has methodName and params, nothing else"

_Parts = deque["Value | Attempt"]


@dataclass(frozen=True, slots=True)
class Multicall:
    """Answers multicalls. The answers to one have as many bytes as one call can be answered."""

    execution: Execution
    parameters: ParameterCalls
    trail: AuditTrail
    offload: int

    async def answer(self, visit: Visit, params: tuple[Value, ...]) -> Value:
        """The answers to the parts of one multicall."""
        if len(params) != 1 or not isinstance(params[0], list):
            why = "system.multicall takes one list of calls"
            self._refused(visit, why)
            return [-1, why, 0]
        left: _Parts = deque(params[0])
        results: list[Value] = []
        room = self.parameters.mirror.bytes_limit
        while left and not (why := await self._why_no_more(visit, room)):
            if _in_run(visit, left[0]):
                run = await self._run(visit, left, room)
                answers = run.answered(await self.execution.answer_run(visit, run.attempts))
            else:
                answers = [await self._one(visit, left.popleft())]
            room -= await self._weigh(visit, answers)
            results += answers
            await asyncio.sleep(0)  # others have their turn
        if left:
            why = f"{why}; {len(left)} more parts are not carried out"
            return results + [self._fault(visit, LIMIT_FAULT, "limit exceeded", why)] * len(left)
        return results

    async def _why_no_more(self, visit: Visit, room: int) -> str:
        """Why no more parts are carried out; empty when they are."""
        if room <= 0:
            return f"the answers to a multicall have more than {self.parameters.mirror.bytes_limit} bytes"
        return await self.trail.still_owing(visit.caller.peer.text)

    async def _run(self, visit: Visit, left: "_Parts", room: int) -> "_Run":
        """The next parts, which are taken from those that are left, as they were understood."""
        run = _Run()
        weight, most = 0, min(room, self.offload)
        while left and len(run.answers) < run.longest and weight < most and _in_run(visit, left[0]):
            attempt = await self._understand(visit, left[0])
            if isinstance(attempt, Attempt):
                if attempt.call.verb is Verb.WRITE:
                    run.written.append(attempt.resource)
                elif touch([attempt.resource], run.written):
                    left[0] = attempt
                    break
                else:
                    run.reads = True
                run.attempts.append(attempt)
                weight += self.parameters.weight_of_answer(attempt)
            left.popleft()
            run.answers.append(None if isinstance(attempt, Attempt) else attempt)
        return run

    async def _one(self, visit: Visit, part: "Value | Attempt") -> Value:
        attempt = await self._understand(visit, part)
        return [await self.execution.answer(visit, attempt)] if isinstance(attempt, Attempt) else attempt

    async def _understand(self, visit: Visit, part: "Value | Attempt") -> "Value | Attempt":
        """A part as it was understood; else what stands for it in the answer."""
        match part:
            case Attempt():
                return part
            case {"methodName": "system.multicall"}:
                return self._refused(visit, "a multicall inside a multicall is not served")
            case {"methodName": str(method), "params": list(params), **rest} if not rest:
                attempt = await self.execution.understand(visit, method, params)
                return attempt if isinstance(attempt, Attempt) else [attempt]
        return self._refused(visit, _FORM)

    async def _weigh(self, visit: Visit, answers: list[Value]) -> int:
        """About how many bytes answers have, which are kept until the other parts have theirs."""
        weight = weigh(answers, self.offload)
        if weight < self.offload:
            return weight
        await visit.bulk.take()
        return await visit.bulk.in_thread(weigh, answers, self.parameters.mirror.bytes_limit)

    def _refused(self, visit: Visit, why: str) -> Value:
        return self._fault(visit, PARSE_FAULT, "malformed", why)

    def _fault(self, visit: Visit, code: int, event: str, why: str) -> Value:
        """A fault in the place of a part's answer, recorded as this event."""
        record = self.trail.happened(
            event,
            why,
            decision="deny",
            host=visit.caller.peer.text,
            category=Category.COMMAND.value,
            resource=MULTICALL,
        )
        return {"faultCode": code, "faultString": with_record(why, record)}


@dataclass(slots=True)
class _Run:
    """Parts that are carried out together, and their answers (None: that of an attempt)."""

    answers: list[Value] = field(default_factory=list)
    attempts: list[Attempt] = field(default_factory=list)
    written: list[str] = field(default_factory=list)
    reads: bool = False

    @property
    def longest(self) -> int:
        """The number of parts that it may have."""
        return _LONGEST_READING if self.reads else _LONGEST_RUN

    def answered(self, attempts: Iterable[Value]) -> list[Value]:
        """All answers, with those of the attempts."""
        given = iter(attempts)
        return [[next(given)] if answer is None else answer for answer in self.answers]


def _in_run(visit: Visit, part: "Value | Attempt") -> bool:
    if isinstance(part, Attempt):
        return part.call.in_run
    name = part.get("methodName") if isinstance(part, dict) else None
    return isinstance(name, str) and name in visit.table and visit.table[name].call.in_run
