"""Call the hidden ROS master over reused connections. A *door* holds calls back while the ROS master is rebuilt.

While the ROS master is down or not yet restored, calls of nodes wait at the door for a limited time. So a registering
node notices only a delay. The reconcile loop shuts and opens the door, and uses `call_now` to call in the meantime.

Small calls (`small` in the table of calls: parameters and answers are a few names) are sent one after the other. A
small call is sent at once if no other small call is under way. Small calls that arrive in the meantime wait for the
answer. They are then sent together as one `system.multicall`, in order. The ROS master is one Python process and does
only one thing at a time. So under load, multicalls save most of the cost in the control process and in the ROS master.

The answers to a multicall are separated again. A fault of one part affects only this part, so callers see no
difference. A call with a parameter's value may be large, slow or impossible to encode. It is sent alone, because its
failure would make other calls fail. If the order of several calls of one caller matters, `in_order` sends them as one
multicall.
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
from roswire.xmlrpc import Value, XmlRpcLimits

_LARGEST = 64  # the most parts of a multicall, because one slow part delays all others
Wanted = tuple[str, tuple[Value, ...]]
_Waiting = tuple[str, tuple[Value, ...], "asyncio.Future[Value]"]


class BatchingClient:
    """A client that makes `small` calls one after the other over `client`, and sends waiting calls together."""

    def __init__(self, client: XmlRpcClient, small: Collection[str]) -> None:
        self._client = client
        self._small = small
        self._waiting: list[_Waiting] = []
        self._busy = False
        self._sending: asyncio.Task[None] | None = None

    async def call(self, method: str, *params: Value) -> Value:
        """Call `method` and return its value. Raises `CallFailedError` and `EncodingError`."""
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
        """Make these calls in order, as one multicall. Return the outcome of each call.

        Raises `CallFailedError` if the multicall has no usable answer. Raises `EncodingError` if nothing was sent.
        """
        parts: list[Value] = [{"methodName": method, "params": list(params)} for method, params in calls]
        values = await self._client.call("system.multicall", parts)
        if not isinstance(values, list) or len(values) != len(calls):
            raise CallFailedError("the ROS master answered a multicall with the wrong number of answers")
        return [_outcome(method, value) for (method, _params), value in zip(calls, values, strict=True)]

    def _send_waiting(self) -> None:
        waiting = [entry for entry in self._waiting if not entry[2].done()]  # the others were cancelled
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
            return CallFailedError(f"the ROS master answered {method} with a fault: {text}")
        case _:
            return CallFailedError(f"the ROS master answered {method} with an invalid response")


def _settle(answer: "asyncio.Future[Value]", outcome: "Value | CallFailedError | EncodingError") -> None:
    if answer.done():
        return
    if isinstance(outcome, CallFailedError | EncodingError):
        # Each caller gets its own exception object. One object in many tasks would mix their tracebacks.
        answer.set_exception(type(outcome)(*outcome.args))
    else:
        answer.set_result(outcome)


_T = TypeVar("_T")


def limits_of_answers(limits: XmlRpcLimits, parameters: int) -> XmlRpcLimits:
    """Return the limits of answers. An answer may be a parameter tree of `parameters` bytes.

    The tree consists of values that `limits` allow.
    """
    return replace(
        limits,
        body=4 * parameters + limits.body,
        elements=parameters,
        depth=limits.depth + 2,
        string=limits.string + 64,
    )


class RosMaster:
    """The ROS master at `127.0.0.1:port`. `doubtful` is set when the ROS master seems to be gone.

    `timeout` and `hold` are in seconds. Concurrent `small` calls are sent together.
    """

    def __init__(
        self,
        port: int,
        *,
        limits: XmlRpcLimits,
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
        """Whether the door is open: the ROS master is running and complete, and no reconcile round is under way."""
        return self._open.is_set()

    @property
    def whole(self) -> bool:
        """Whether the ROS master is running and complete, even while a reconcile round has shut the door."""
        return not self._away

    async def call(self, method: str, *params: Value) -> Answer:
        """Make a call for a node. Wait while the door is shut. Raises `CallFailedError` if the door stays shut."""
        return await self._call(lambda: self.call_now(method, *params))

    async def call_in_order(self, calls: Sequence[Wanted]) -> list[Answer | CallFailedError]:
        """Make several calls in order, like `call`. Return the outcome of each call."""
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
                    while not self._open.is_set():  # the door may be shut again before this task runs
                        await self._open.wait()
                    with contextlib.suppress(RefusedError, BrokenOffError):
                        return await self._pass(make)
        except TimeoutError:
            raise CallFailedError(f"the ROS master did not come back within {self._hold:g} s") from None

    async def _pass(self, make: Callable[[], Awaitable[_T]]) -> _T:
        """Make a call through the open door. Shut the door if the ROS master refuses or breaks the connection."""
        self._enter()
        try:
            return await make()
        except (RefusedError, BrokenOffError):
            self._lost()
            raise
        finally:
            self._leave()

    async def call_now(self, method: str, *params: Value) -> Answer:
        """Make a call for the reconcile loop, even while the door is shut. Raises `CallFailedError`."""
        answer = _answer_to(method, await self.calls.call(method, *params))
        if isinstance(answer, CallFailedError):
            raise answer
        return answer

    def _lost(self) -> None:
        self.shut()
        self.doubtful.set()

    def shut(self) -> None:
        """Shut the door, because the ROS master is away or not yet restored. Calls wait from now on."""
        self._open.clear()
        self._away = True

    @contextlib.asynccontextmanager
    async def alone(self) -> AsyncIterator[None]:
        """Shut the door, and wait until calls under way have ended. Open the door again unless the block fails."""
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
    """Start these calls in order, without waiting for their answers in between. Return their results.

    There may be thousands of calls, made while the door is shut and all other calls wait. If a call fails, cancel the
    others and raise `CallFailedError`.
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
        f"the ROS master answered {method} with something that is not [code, message, value]"
    )


_PACKAGE = Path("/usr/share/rosmaster/package.xml")

_log = structlog.get_logger()


def own_parameters() -> Tree:
    """Return the parameters that `roscore` sets on a new ROS master, with a new `/run_id`."""
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
