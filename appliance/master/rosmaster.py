"""Call the hidden ROS master over reused connections. A *door* holds calls back while the ROS master is rebuilt.

The reconcile loop shuts and opens the door, and calls through it in the meantime (`call_now`, `all_now`). Calls whose
order matters are sent as one `system.multicall`, which also saves most of their cost: the ROS master does one thing
at a time.
"""

import asyncio
import contextlib
import os
import re
import uuid
from collections.abc import AsyncIterator, Awaitable, Callable, Sequence
from dataclasses import replace
from pathlib import Path
from typing import TypeVar

import structlog

from appliance.master.caller import Answer
from appliance.rpc.xmlrpc_client import BrokenOffError, CallFailedError, RefusedError, XmlRpcClient
from roswire.parameter_tree import Tree
from roswire.uris import NodeUri
from roswire.xmlrpc import Value, XmlRpcLimits

LARGEST_MULTICALL = 64
"""The most parts of a multicall, because one slow part delays all others."""

Wanted = tuple[str, tuple[Value, ...]]
"""A wanted call: the method, and its parameters."""

_T = TypeVar("_T")


def limits_of_answers(limits: XmlRpcLimits, parameters: int) -> XmlRpcLimits:
    return replace(
        limits,
        body=4 * parameters + limits.body,
        elements=parameters,
        depth=limits.depth + 2,
        string=limits.string + 64,
    )


class RosMaster:
    """The ROS master on the loopback. `doubtful` is set when it seems to be gone. Times are in seconds."""

    def __init__(
        self,
        port: int,
        *,
        limits: XmlRpcLimits,
        timeout: float = 10.0,
        hold: float = 15.0,
    ) -> None:
        self.port = port
        self.doubtful = asyncio.Event()
        self._hold = hold
        self.calls = XmlRpcClient(
            NodeUri("http", "127.0.0.1", port, "/"),
            timeout=timeout,
            pool=32,
            bare=True,
            limits=limits,
            disconnected=self._lost,
        )
        self._open = asyncio.Event()
        self._away = True
        self._alone = asyncio.Lock()
        self._inside = 0
        self._empty = asyncio.Event()
        self._empty.set()

    @property
    def reachable(self) -> bool:
        """Whether the ROS master is complete, and no reconcile round is under way."""
        return self._open.is_set()

    @property
    def whole(self) -> bool:
        """Whether the ROS master is complete, even during a reconcile round."""
        return not self._away

    async def call(self, method: str, *params: Value) -> Answer:
        """Make a call for a node once the door is open. Raises `CallFailedError` if it stays shut."""
        return await self._call(lambda: self.call_now(method, *params))

    async def call_in_order(self, calls: Sequence[Wanted]) -> list[Answer | CallFailedError]:
        return await self._call(lambda: self._in_order(calls))

    async def call_once(self, calls: Sequence[Wanted]) -> list[Answer | CallFailedError]:
        """Make several calls in order through the open door, and never repeat them.

        If they fail, shut the door until the next reconcile round, and raise `CallFailedError`.
        """
        try:
            return await self._pass(lambda: self._in_order(calls))
        except CallFailedError:
            self._lost()
            raise

    async def _in_order(self, calls: Sequence[Wanted]) -> list[Answer | CallFailedError]:
        if len(calls) == 1:
            [(method, params)] = calls
            return [_answer_to(method, await self.calls.call(method, *params))]
        parts: list[Value] = [{"methodName": method, "params": list(params)} for method, params in calls]
        values = await self.calls.call("system.multicall", parts)
        if not isinstance(values, list) or len(values) != len(calls):
            raise CallFailedError("the ROS master answered a multicall with the wrong number of answers")
        return [_outcome(method, value) for (method, _params), value in zip(calls, values, strict=True)]

    async def _call(self, make: Callable[[], Awaitable[_T]]) -> _T:
        if self._open.is_set():
            with contextlib.suppress(RefusedError, BrokenOffError):
                return await self._pass(make)
        async with self.patience():
            while True:
                await self.opened()
                with contextlib.suppress(RefusedError, BrokenOffError):
                    return await self._pass(make)

    async def opened(self) -> None:
        while not self._open.is_set():  # the door may be shut again before this task runs
            await self._open.wait()

    @contextlib.asynccontextmanager
    async def patience(self) -> AsyncIterator[None]:
        try:
            async with asyncio.timeout(self._hold):
                yield
        except TimeoutError:
            raise CallFailedError(f"the ROS master did not come back within {self._hold:g} s") from None

    async def _pass(self, make: Callable[[], Awaitable[_T]]) -> _T:
        self._enter()
        try:
            return await make()
        except (RefusedError, BrokenOffError):
            self._lost()
            raise
        finally:
            self._leave()

    async def call_now(self, method: str, *params: Value) -> Answer:
        """Make a call even while the door is shut. Raises `CallFailedError`."""
        answer = _answer_to(method, await self.calls.call(method, *params))
        if isinstance(answer, CallFailedError):
            raise answer
        return answer

    async def all_now(self, calls: Sequence[Wanted]) -> list[Answer]:
        answers: list[Answer] = []
        for start in range(0, len(calls), LARGEST_MULTICALL):
            for answer in await self._in_order(calls[start : start + LARGEST_MULTICALL]):
                if isinstance(answer, CallFailedError):
                    raise answer
                answers.append(answer)
        return answers

    def _lost(self) -> None:
        self.shut()
        self.doubtful.set()

    def shut(self) -> None:
        self._open.clear()
        self._away = True

    @contextlib.asynccontextmanager
    async def alone(self) -> AsyncIterator[None]:
        """Shut the door, and wait until calls under way have ended; open it again unless the block fails."""
        async with self._alone:
            self._open.clear()
            await self._empty.wait()
            yield
            self._open.set()
            self._away = False

    def close(self) -> None:
        self.calls.close()

    def _enter(self) -> None:
        self._inside += 1
        self._empty.clear()

    def _leave(self) -> None:
        self._inside -= 1
        if not self._inside:
            self._empty.set()


def _outcome(method: str, value: Value) -> Answer | CallFailedError:
    match value:
        case [one]:
            return _answer_to(method, one)
        case {"faultString": str(text)}:
            return CallFailedError(f"the ROS master answered {method} with a fault: {text}")
        case _:
            return CallFailedError(f"the ROS master answered {method} with an invalid response")


def _answer_to(method: str, value: Value) -> Answer | CallFailedError:
    if isinstance(value, list) and len(value) == 3 and isinstance(value[0], int):
        return value
    return CallFailedError(
        f"the ROS master answered {method} with something that is not [code, message, value]"
    )


_PACKAGE = Path("/usr/share/rosmaster/package.xml")

_log = structlog.get_logger()


def own_parameters() -> Tree:
    tree: Tree = {"run_id": str(uuid.uuid1()), "rosdistro": os.environ.get("ROS_DISTRO", "Debian") + "\n"}
    try:
        text = _PACKAGE.read_text(encoding="utf-8")
    except OSError as error:
        _log.warning("the version of ROS is not known: /rosversion is not set", error=str(error))
        return tree
    version = re.search(r"<version>\s{0,9}+([^<\s]{1,40}+)", text)
    if version is not None:
        tree["rosversion"] = version[1] + "\n"
    return tree
