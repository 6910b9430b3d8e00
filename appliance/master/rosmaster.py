"""The hidden ROSMaster as control calls it: kept-alive connections, and a door that is shut while it is rebuilt.

While ROSMaster is down, or up but not yet told everything again, calls of nodes wait at the door (bounded): a node
that registers in that moment notices nothing but a delay. The reconcile loop shuts the door, passes it with
`call_now`, and opens it.
"""

import asyncio
import contextlib
from collections.abc import AsyncIterator, Awaitable, Callable, Collection, Sequence
from dataclasses import replace
from typing import TypeVar

from appliance.master.batch import BatchingClient, Wanted
from appliance.master.caller import Answer
from appliance.ros.uris import NodeUri
from appliance.ros.xmlrpc import Limits, Value
from appliance.rpc.client import BrokenOffError, CallFailedError, RefusedError, XmlRpcClient

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
        self._calls = BatchingClient(self._client, small)
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
        outcomes = await self._calls.in_order(calls)
        return [
            one if isinstance(one, CallFailedError) else _answer_to(method, one)
            for (method, _params), one in zip(calls, outcomes, strict=True)
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
        answer = _answer_to(method, await self._calls.call(method, *params))
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
