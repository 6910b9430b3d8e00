"""The hidden ROSMaster as control calls it: kept-alive connections, and a door that is shut while it is rebuilt.

While ROSMaster is down, or up but not yet told everything again, calls of nodes wait at the door (bounded): a node
that registers in that moment notices nothing but a delay. The reconcile loop shuts the door, passes it with
`call_now`, and opens it.

Calls whose parameters and answers are a few names (`small` in the table of calls) go one after the other: what comes
while one is under way waits for its answer, and then travels with all others that wait, as one `system.multicall`, in
their order. ROSMaster is one Python process, which does one thing at a time anyway; under load this saves most of what
two processes cost each other, and a call that finds nothing under way goes at once. The answers are taken apart again,
so that nobody notices: a fault of one part is that part's fault. What may be large, slow or impossible to write (a
parameter's value) travels alone: it could fail, and would take the calls of others with it. One caller's own run of
calls, whose order counts, travels together by `in_order`.
"""

import asyncio
import contextlib
import os
import re
import uuid
from collections.abc import AsyncIterator, Awaitable, Callable, Collection, Coroutine, Iterable, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any, TypeVar

import structlog

from appliance.master.caller import Answer
from appliance.rpc.xmlrpc_client import BrokenOffError, CallFailedError, RefusedError, XmlRpcClient
from roswire.errors import EncodingError
from roswire.parameter_tree import Tree
from roswire.uris import NodeUri
from roswire.xmlrpc import Limits, Value

_LARGEST = 64  # parts of one multicall: what one slow part can hold up
Wanted = tuple[str, tuple[Value, ...]]
_Waiting = tuple[str, tuple[Value, ...], "asyncio.Future[Value]"]


class BatchingClient:
    """Makes calls that are `small` over `client`, one after the other: those that wait together go together."""

    def __init__(self, client: XmlRpcClient, small: Collection[str]) -> None:
        self._client = client
        self._small = small
        self._waiting: list[_Waiting] = []
        self._busy = False
        self._sending: asyncio.Task[None] | None = None

    async def call(self, method: str, *params: Value) -> Value:
        """Call `method` and return its value. Raises `CallFailedError`, `EncodingError`."""
        if method not in self._small:
            return await self._client.call(method, *params)
        if self._busy:
            answer: asyncio.Future[Value] = asyncio.get_running_loop().create_future()
            self._waiting.append((method, params, answer))
            return await answer
        self._busy = True
        try:
            return await self._client.call(method, *params)
        finally:
            self._send_waiting()

    async def in_order(self, calls: Sequence[Wanted]) -> "list[Value | CallFailedError]":
        """Make these calls as one, one after the other; the outcome of each.

        Raises `CallFailedError` when there is no usable answer for any, `EncodingError` when nothing was sent.
        """
        parts: list[Value] = [{"methodName": method, "params": list(params)} for method, params in calls]
        values = await self._client.call("system.multicall", parts)
        if not isinstance(values, list) or len(values) != len(calls):
            raise CallFailedError("the ROS Master answered a multicall with another number of answers")
        return [_outcome(method, value) for (method, _params), value in zip(calls, values, strict=True)]

    def _send_waiting(self) -> None:
        waiting = [entry for entry in self._waiting if not entry[2].done()]  # the others have been given up
        part, self._waiting = waiting[:_LARGEST], waiting[_LARGEST:]
        self._busy = bool(part)
        if part:
            self._sending = asyncio.get_running_loop().create_task(self._send(part))

    async def _send(self, part: list[_Waiting]) -> None:
        outcomes: Sequence[Value | CallFailedError | EncodingError]
        try:
            if len(part) == 1:
                method, params, _answer = part[0]
                outcomes = [await self._client.call(method, *params)]
            else:
                outcomes = await self.in_order([(method, params) for method, params, _answer in part])
        except (CallFailedError, EncodingError) as error:
            outcomes = [error] * len(part)
        finally:
            self._send_waiting()
        for (_method, _params, answer), outcome in zip(part, outcomes, strict=True):
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
        self._away = True
        self._alone = asyncio.Lock()
        self._inside = 0
        self._empty = asyncio.Event()
        self._empty.set()

    @property
    def reachable(self) -> bool:
        """Whether calls pass (ROSMaster is there and whole)."""
        return self._open.is_set()

    @property
    def whole(self) -> bool:
        """Whether ROSMaster is there and knows everything, also while a look at it has calls wait for a moment."""
        return not self._away

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
        self.shut()
        self.doubtful.set()

    def shut(self) -> None:
        """Let calls wait from now on: ROSMaster is away, or knows nothing yet."""
        self._open.clear()
        self._away = True

    @contextlib.asynccontextmanager
    async def alone(self) -> AsyncIterator[None]:
        """Shut the door and wait until those inside have left; it opens again unless the work inside fails."""
        async with self._alone:
            self._open.clear()
            await self._empty.wait()
            yield
            self._open.set()
            self._away = False

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


async def together(calls: Iterable[Coroutine[Any, Any, _T]]) -> list[_T]:
    """Make these calls in their order, none waiting for the one before; what they return.

    For who shuts the door: everybody waits for the last of what may be thousands. Raises `CallFailedError`; the others
    are given up then.
    """
    try:
        async with asyncio.TaskGroup() as group:
            tasks = [group.create_task(call) for call in calls]
    except ExceptionGroup as failed:
        raise failed.exceptions[0] from failed
    return [task.result() for task in tasks]


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
