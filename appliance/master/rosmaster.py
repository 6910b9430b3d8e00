"""Call the ROS master, and state the registrations to it.

Calls use kept connections. A *door* holds them back while the ROS master is rebuilt.

The reconcile loop shuts and opens the door, and calls through it in the meantime (`call_now`, `all_now`). Calls whose
order matters are sent as one `system.multicall`, which also saves most of their cost: the ROS master does one thing
at a time.

Registrations are stated after the answers to nodes:

1. No answer to a node depends on a forwarded change. All reads of the graph are answered from the registry.
2. `_stated` has the registrations that the ROS master has, or will have after the one request under way. `_differing`
   has the keys that differ from it, in the order of their changes.
3. A request that fails is not repeated. It shuts the door, and the next round of the reconcile loop reads what the
   ROS master has (`adopt`), as after the death of control.
"""

import asyncio
import contextlib
import os
import re
import uuid
from collections.abc import AsyncIterator, Awaitable, Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import NamedTuple, TypeVar

import structlog

from appliance.master.graph.registry import Change, Incarnation, Kind, RegistrationKey, Registry
from appliance.master.graph.revocation import CALLS
from appliance.rpc.xmlrpc_client import BrokenOffError, CallFailedError, RefusedError, XmlRpcClient
from roswire.parameter_tree import Tree
from roswire.uris import NodeUri, service_uri
from roswire.xmlrpc import Value, XmlRpcLimits

LARGEST_MULTICALL = 64
"""The most parts of a multicall, because one slow part delays all others."""

Answer = list[Value]
"""The result of a call: `[code, message, value]`; code 1 done, 0 failed or denied, -1 the caller's error."""

Wanted = tuple[str, tuple[Value, ...]]
"""A wanted call: the method, and its parameters."""

NAME = "/master"
_GATHER_SECONDS = 0.1  # gathered changes cost half the processor time

EntryKey = tuple[Kind, str, str]
"""The kind, the resource, and the name of the node."""

_T = TypeVar("_T")
_log = structlog.get_logger()


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

    async def wait(self) -> bool:
        """Wait for the open door, at most as long as a call does; return whether other code may have run."""
        if self._open.is_set():
            return False
        with contextlib.suppress(CallFailedError):
            async with self.patience():
                await self.opened()
        return True

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


class MasterEntry(NamedTuple):
    """The URI of a node, and the type of the topic or the URI of the service."""

    api: str
    detail: str


class MasterRegistrations:
    """The registrations at the ROS master. `pid` is the ROS master that has all of them."""

    def __init__(
        self, rosmaster: RosMaster, registry: Registry, inner_uri: Callable[[Incarnation], str]
    ) -> None:
        self._rosmaster = rosmaster
        self._registry = registry
        self._inner_uri = inner_uri
        self._stated: dict[EntryKey, MasterEntry] = {}
        self._differing: dict[EntryKey, None] = {}
        self._sending: asyncio.Task[None] | None = None
        self.pid: int | None = None

    def flush(self, changed: Iterable[Change]) -> None:
        for change in changed:
            if isinstance(change, Incarnation):
                for kind, resource in change.registrations:
                    self._compare((kind, resource, change.name))
            elif isinstance(change, RegistrationKey):
                self._compare((change.kind, change.resource, change.node.name))
        if self._differing and (self._sending is None or self._sending.done()):
            self._sending = asyncio.get_running_loop().create_task(self._send())

    def adopt(self, seen: Mapping[EntryKey, MasterEntry]) -> int:
        """Take over the ROS master's state. Return the number of differences from the wanted one."""
        self._stated = dict(seen)
        self._differing.clear()
        for node, registration in self._registry.in_order():
            self._compare((registration.kind, registration.resource, node.name))
        missing = len(self._differing)
        for key in sorted(seen):
            self._compare(key)
        return missing

    @property
    def differing(self) -> int:
        return len(self._differing)

    def take(self, most: int | None = None) -> list[Wanted]:
        calls: list[Wanted] = []
        for key in list(self._differing):
            if most is not None and len(calls) + 2 > most:
                break
            del self._differing[key]
            wanted, stated = self.wanted_entry(key), self._stated.pop(key, None)
            calls += _calls(key, stated, wanted)
            if wanted is not None:
                self._stated[key] = wanted
        return calls

    def wanted_entry(self, key: EntryKey) -> MasterEntry | None:
        kind, resource, name = key
        node = self._registry.holder(name)
        registration = None if node is None else node.registrations.get((kind, resource))
        if node is None or registration is None or kind is Kind.PARAMETER:
            return None
        service = kind is Kind.SERVICE
        return MasterEntry(self._inner_uri(node), stand_in(node) if service else registration.detail)

    def _compare(self, key: EntryKey) -> None:
        if self.wanted_entry(key) == self._stated.get(key):
            self._differing.pop(key, None)
        else:
            self._differing[key] = None

    async def _send(self) -> None:
        while self._differing:
            if len(self._differing) < LARGEST_MULTICALL:
                await asyncio.sleep(_GATHER_SECONDS)
            await self._rosmaster.opened()
            part = self.take(LARGEST_MULTICALL)
            if not part:  # the changes have cancelled one another, or a round has sent them
                continue
            try:
                answers = await self._rosmaster.call_once(part)
            except CallFailedError as error:
                _log.warning("changes did not reach the ROS master", number=len(part), error=str(error))
                continue
            for (method, params), answer in zip(part, answers, strict=True):
                if isinstance(answer, CallFailedError) or answer[0] != 1:
                    _log.error(
                        "the ROS master rejected a change", call=method, of=params[:2], answer=str(answer)
                    )
                    self._rosmaster.doubtful.set()


def _calls(key: EntryKey, stated: MasterEntry | None, wanted: MasterEntry | None) -> Iterator[Wanted]:
    kind, resource, name = key
    register, unregister = CALLS[kind]
    if stated is not None and (wanted is None or wanted.api != stated.api):
        yield unregister, (name, resource, stated.detail if kind is Kind.SERVICE else stated.api)
    if wanted is not None:
        yield register, (name, resource, wanted.detail, wanted.api)


def stand_in(node: Incarnation) -> str:
    """Return the URI of a node's services at the ROS master. Clients never get it."""
    return service_uri(node.key, node.relay_port)


_PACKAGE = Path("/usr/share/rosmaster/package.xml")


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
