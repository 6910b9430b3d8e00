"""Answer `system.multicall`. The parts are carried out in order, and a failed part does not affect other parts.

Adjacent reads and writes of parameters form a *run*, which waits once for the disk and for the ROS master. A read of
a parameter that the run writes begins a new run. Other hosts have their turn between runs and other parts.
"""

import asyncio
from collections import deque
from collections.abc import Iterable
from dataclasses import dataclass, field

from appliance.base.counted import counted
from appliance.master.calls.call import Attempt, CallVerb, with_record
from appliance.master.calls.call_execution import Execution, ServedRequest, touch
from appliance.master.calls.parameter_calls import ParameterCalls
from appliance.policy.model import Category
from appliance.rpc.fair_queue import weigh
from appliance.telemetry.audit_trail import AuditTrail
from roswire.xmlrpc import Value

MULTICALL = "system.multicall"
PARSE_FAULT, LIMIT_FAULT = -32700, -32600
_LONGEST_RUN = 64  # the most parts that reach the ROS master in one request
_LONGEST_READING = 8  # the most parts of a run with reads; other hosts wait until all are answered
_FORM = "a part of a multicall has methodName and params, nothing else"

_Parts = deque["Value | Attempt"]


@dataclass(frozen=True, slots=True)
class Multicall:
    """Answers multicalls. All answers to one multicall together have at most `mirror.bytes_limit` bytes."""

    execution: Execution
    parameters: ParameterCalls
    trail: AuditTrail
    offload: int

    async def answer(self, visit: ServedRequest, params: tuple[Value, ...]) -> Value:
        if len(params) != 1 or not isinstance(params[0], list):
            why = "system.multicall takes one list of calls"
            self._refuse(visit, why)
            return [-1, why, 0]
        visit = visit._replace(caller=visit.caller._replace(in_multicall=True))
        left: _Parts = deque(params[0])
        results: list[Value] = []
        room = self.parameters.mirror.bytes_limit
        while left and not (why := await self._why_no_more(visit, room)):
            if _in_run(visit, left[0]):
                run = await self._run(visit, left, room)
                answers = run.merge_answers(await self.execution.answer_run(visit, run.attempts, run.weight))
            else:
                answers = [await self._one(visit, left.popleft())]
            room -= await self._weigh(visit, answers)
            results += answers
            await asyncio.sleep(0)  # other hosts have their turn
        if left:
            why = f"{why}; {counted(len(left), 'more part is', 'more parts are')} not carried out"
            return results + [self._fault(visit, LIMIT_FAULT, "limit exceeded", why)] * len(left)
        return results

    async def _why_no_more(self, visit: ServedRequest, room: int) -> str:
        if room <= 0:
            return f"the answers to a multicall have more than {self.parameters.mirror.bytes_limit} bytes"
        return await self.trail.still_owing(visit.caller.peer.text)

    async def _run(self, visit: ServedRequest, left: "_Parts", room: int) -> "_Run":
        run, most = _Run(), min(room, self.offload)
        while left and len(run.answers) < run.longest and run.weight < most and _in_run(visit, left[0]):
            attempt = await self._understand(visit, left[0])
            if isinstance(attempt, Attempt):
                if attempt.call.verb is CallVerb.WRITE:
                    run.written.append(attempt.resource)
                elif run.written and touch([attempt.resource], run.written):
                    left[0] = attempt
                    break
                else:
                    run.reads = True
                run.attempts.append(attempt)
                run.weight += self.parameters.weight_of_answer(attempt)
            left.popleft()
            run.answers.append(None if isinstance(attempt, Attempt) else attempt)
        return run

    async def _one(self, visit: ServedRequest, part: "Value | Attempt") -> Value:
        attempt = await self._understand(visit, part)
        return [await self.execution.answer(visit, attempt)] if isinstance(attempt, Attempt) else attempt

    async def _understand(self, visit: ServedRequest, part: "Value | Attempt") -> "Value | Attempt":
        match part:
            case Attempt():
                return part
            case {"methodName": "system.multicall"}:
                return self._refuse(visit, "a multicall inside a multicall is not served")
            case {"methodName": str(method), "params": list(params), **rest} if not rest:
                attempt = await self.execution.understand(visit, method, params)
                return attempt if isinstance(attempt, Attempt) else [attempt]
        return self._refuse(visit, _FORM)

    async def _weigh(self, visit: ServedRequest, answers: list[Value]) -> int:
        weight = weigh(answers, self.offload)
        if weight < self.offload:
            return weight
        await visit.bulk.take()
        return await visit.bulk.in_thread(weigh, answers, self.parameters.mirror.bytes_limit)

    def _refuse(self, visit: ServedRequest, why: str) -> Value:
        return self._fault(visit, PARSE_FAULT, "malformed", why)

    def _fault(self, visit: ServedRequest, code: int, event: str, why: str) -> Value:
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
    """Parts that are carried out together, and their answers; the answers to reads have about `weight` bytes."""

    answers: list[Value] = field(default_factory=list)
    attempts: list[Attempt] = field(default_factory=list)
    written: list[str] = field(default_factory=list)
    reads: bool = False
    weight: int = 0

    @property
    def longest(self) -> int:
        return _LONGEST_READING if self.reads else _LONGEST_RUN

    def merge_answers(self, attempts: Iterable[Value]) -> list[Value]:
        given = iter(attempts)
        return [[next(given)] if answer is None else answer for answer in self.answers]


def _in_run(visit: ServedRequest, part: "Value | Attempt") -> bool:
    if isinstance(part, Attempt):
        return part.call.in_run
    name = part.get("methodName") if isinstance(part, dict) else None
    return isinstance(name, str) and name in visit.table and visit.table[name].call.in_run
