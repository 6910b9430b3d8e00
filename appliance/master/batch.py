"""Calls that are made in the same turn of the loop travel to ROSMaster as one `system.multicall`, in their order.

Under load this saves most of the system calls between the two processes; a call that is alone travels alone. The
answers are taken apart again, so that nobody notices: a fault of one part is that part's fault.

Only calls whose parameters and answers are a few names travel together (`small` in the table of calls). What may be
large, slow or impossible to write (a parameter's value) travels alone: it could fail, and would take the calls of
others with it. One caller's own run of calls, whose order counts, travels together by `in_order`.
"""

import asyncio
from collections.abc import Collection, Sequence

from appliance.ros.errors import EncodingError
from appliance.ros.xmlrpc import Value
from appliance.rpc.client import CallFailedError, XmlRpcClient

_LARGEST = 64  # parts of one multicall: what one slow part can hold up
Wanted = tuple[str, tuple[Value, ...]]
_Waiting = tuple[str, tuple[Value, ...], "asyncio.Future[Value]"]


class BatchingClient:
    """Makes those calls of one turn of the loop together that are `small`, over `client`."""

    def __init__(self, client: XmlRpcClient, small: Collection[str]) -> None:
        self._client = client
        self._small = small
        self._waiting: list[_Waiting] = []
        self._sending: set[asyncio.Task[None]] = set()

    async def call(self, method: str, *params: Value) -> Value:
        """Call `method` and return its value. Raises `CallFailedError`, `EncodingError`."""
        if method not in self._small:
            return await self._client.call(method, *params)
        loop = asyncio.get_running_loop()
        answer: asyncio.Future[Value] = loop.create_future()
        self._waiting.append((method, params, answer))
        if len(self._waiting) == 1:
            loop.call_soon(self._send)
        return await answer

    async def in_order(self, calls: Sequence[Wanted]) -> "list[Value | CallFailedError]":
        """Make these calls as one, one after the other; the outcome of each.

        Raises `CallFailedError` when there is no usable answer for any, `EncodingError` when nothing was sent.
        """
        parts: list[Value] = [{"methodName": method, "params": list(params)} for method, params in calls]
        values = await self._client.call("system.multicall", parts)
        if not isinstance(values, list) or len(values) != len(calls):
            raise CallFailedError("the ROS Master answered a multicall with another number of answers")
        return [_outcome(method, value) for (method, _params), value in zip(calls, values, strict=True)]

    def _send(self) -> None:
        waiting, self._waiting = self._waiting, []
        for begin in range(0, len(waiting), _LARGEST):
            part = waiting[begin : begin + _LARGEST]
            task = asyncio.get_running_loop().create_task(
                self._one(part[0]) if len(part) == 1 else self._many(part)
            )
            self._sending.add(task)
            task.add_done_callback(self._sending.discard)

    async def _one(self, waiting: _Waiting) -> None:
        method, params, answer = waiting
        try:
            value = await self._client.call(method, *params)
        except (CallFailedError, EncodingError) as error:
            _settle(answer, error)
        else:
            _settle(answer, value)

    async def _many(self, waiting: list[_Waiting]) -> None:
        try:
            outcomes = await self.in_order([(method, params) for method, params, _answer in waiting])
        except (CallFailedError, EncodingError) as error:
            for _method, _params, answer in waiting:
                _settle(answer, error)
            return
        for (_method, _params, answer), outcome in zip(waiting, outcomes, strict=True):
            _settle(answer, outcome)


def _outcome(method: str, value: Value) -> "Value | CallFailedError":
    match value:
        case [one]:
            return one
        case {"faultString": str(text)}:
            return CallFailedError(f"the ROS Master answered {method} with a fault: {text}")
        case _:
            return CallFailedError(f"the ROS Master answered {method} with nonsense")


def _settle(answer: "asyncio.Future[Value]", outcome: "Value | CallFailedError | EncodingError") -> None:
    if answer.done():
        return
    if isinstance(outcome, CallFailedError | EncodingError):
        # Each caller raises an exception of its own: one object raised in many tasks would mix their tracebacks.
        answer.set_exception(type(outcome)(*outcome.args))
    else:
        answer.set_result(outcome)
