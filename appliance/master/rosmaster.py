"""The hidden ROSMaster as control calls it: kept-alive connections, and a door that is shut while it is rebuilt.

While ROSMaster is down, or up but not yet told everything again, calls of nodes wait at the door (bounded): a node
that registers in that moment notices nothing but a delay. The reconcile loop shuts the door, passes it with
`call_now`, and opens it.

Calls that are made in the same turn of the loop travel as one `system.multicall`, in their order. Under load this saves
most of the system calls between the two processes; a call that is alone travels alone. The answers are taken apart
again, so that nobody notices: a fault of one part is that part's fault. Only calls whose parameters and answers are a
few names travel together (`small` in the table of calls). What may be large, slow or impossible to write (a parameter's
value) travels alone: it could fail, and would take the calls of others with it. One caller's own run of calls, whose
order counts, travels together by `in_order`.
"""

import asyncio
import contextlib
import os
import re
import uuid
from collections.abc import AsyncIterator, Awaitable, Callable, Collection, Sequence
from dataclasses import replace
from pathlib import Path
from typing import TypeVar

import structlog

from appliance.master.caller import Answer
from appliance.ros.errors import EncodingError
from appliance.ros.parameter_tree import Tree
from appliance.ros.uris import NodeUri
from appliance.ros.xmlrpc import Limits, Value
from appliance.rpc.client import BrokenOffError, CallFailedError, RefusedError, XmlRpcClient

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


_T = TypeVar("_T")


def limits_of_answers(limits: Limits, parameters: int) -> Limits:
    """What ROSMaster may answer: the whole parameter tree of `parameters` bytes, which `limits` let in by parts."""
    return replace(
        limits,
        body=4 * parameters + limits.body,
        elements=parameters,
        depth=limits.depth + 2,
        string=limits.string + 64,
    )


class RosMaster:
    """ROSMaster at `127.0.0.1:port`; `doubtful` is set when it seems to be gone. Times are seconds.

    Calls that are `small` travel together.
    """

    def __init__(
        self,
        port: int,
        *,
        limits: Limits,
        small: Collection[str] = (),
        timeout: float = 10.0,
        hold: float = 15.0,
    ) -> None:
        self.port = port
        self.doubtful = asyncio.Event()
        self._hold = hold
        self._client = XmlRpcClient(
            NodeUri("http", "127.0.0.1", port, "/"),
            timeout=timeout,
            pool=32,
            limits=limits,
            disconnected=self._lost,
        )
        self.calls = BatchingClient(self._client, small)
        self._open = asyncio.Event()
        self._alone = asyncio.Lock()
        self._inside = 0
        self._empty = asyncio.Event()
        self._empty.set()

    @property
    def reachable(self) -> bool:
        """Whether calls pass (ROSMaster is there and whole)."""
        return self._open.is_set()

    async def call(self, method: str, *params: Value) -> Answer:
        """Call for a node; waits while the door is shut. Raises `CallFailedError` when it stays shut."""
        return await self._call(lambda: self.call_now(method, *params))

    async def call_in_order(self, calls: Sequence[Wanted]) -> list[Answer | CallFailedError]:
        """The same for several calls, carried out one after the other: the outcome of each, for itself."""
        return await self._call(lambda: self._in_order(calls))

    async def _in_order(self, calls: Sequence[Wanted]) -> list[Answer | CallFailedError]:
        outcomes = await self.calls.in_order(calls)
        return [
            call if isinstance(call, CallFailedError) else _answer_to(method, call)
            for (method, _params), call in zip(calls, outcomes, strict=True)
        ]

    async def _call(self, make: Callable[[], Awaitable[_T]]) -> _T:
        if self._open.is_set():
            with contextlib.suppress(RefusedError, BrokenOffError):
                return await self._pass(make)
        try:
            async with asyncio.timeout(self._hold):
                while True:
                    while not self._open.is_set():  # it may be shut again before we are woken
                        await self._open.wait()
                    with contextlib.suppress(RefusedError, BrokenOffError):
                        return await self._pass(make)
        except TimeoutError:
            raise CallFailedError(f"the ROS Master did not come back within {self._hold:g} s") from None

    async def _pass(self, make: Callable[[], Awaitable[_T]]) -> _T:
        """Call through the open door; shuts it when nobody is behind it."""
        self._enter()
        try:
            return await make()
        except (RefusedError, BrokenOffError):
            self._lost()
            raise
        finally:
            self._leave()

    async def call_now(self, method: str, *params: Value) -> Answer:
        """Call whether or not the door is open: for the reconcile loop."""
        answer = _answer_to(method, await self.calls.call(method, *params))
        if isinstance(answer, CallFailedError):
            raise answer
        return answer

    def _lost(self) -> None:
        self._open.clear()
        self.doubtful.set()

    def shut(self) -> None:
        """Let calls wait from now on: ROSMaster is away."""
        self._open.clear()

    @contextlib.asynccontextmanager
    async def alone(self) -> AsyncIterator[None]:
        """Shut the door and wait until those inside have left; it opens again unless the work inside fails."""
        async with self._alone:
            self._open.clear()
            await self._empty.wait()
            yield
            self._open.set()

    def close(self) -> None:
        """Close the connections."""
        self._client.close()

    def _enter(self) -> None:
        self._inside += 1
        self._empty.clear()

    def _leave(self) -> None:
        self._inside -= 1
        if not self._inside:
            self._empty.set()


def _answer_to(method: str, value: Value) -> Answer | CallFailedError:
    if isinstance(value, list) and len(value) == 3 and isinstance(value[0], int):
        return value
    return CallFailedError(
        f"the ROS Master answered {method} with something that is not [code, message, value]"
    )


_PACKAGE = Path("/usr/share/rosmaster/package.xml")

_log = structlog.get_logger()


def own_parameters() -> Tree:
    """What `roscore` sets on a new ROSMaster; a fresh `/run_id` at each call."""
    tree: Tree = {"run_id": str(uuid.uuid1()), "rosdistro": os.environ.get("ROS_DISTRO", "Debian") + "\n"}
    try:
        text = _PACKAGE.read_text(encoding="utf-8")
    except OSError as error:
        _log.warning("the version of ROS is not known: /rosversion is not set", error=str(error))
        return tree
    version = re.search(r"<version>\s*([^<\s]+)", text)
    if version is not None:
        tree["rosversion"] = version[1] + "\n"
    return tree
