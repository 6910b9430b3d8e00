"""Call nodes at their peer address, and deliver the calls that they expect from a master.

After a node was killed, another node may get its port. So a shutdown of an earlier incarnation is not sent to the
address of a live node, and a call that probes or ends a node opens a new connection. Several live nodes may share an
address, because some programs serve several names with one API. The size limit for answers is small, because thousands
of nodes may answer at once, and each may be compromised.

A slow or dead node does not delay other nodes. A node that cannot be called (`Incarnation.reached`) gets no calls.

If several lists of a topic's publishers wait for a node, it gets only the newest. If a publisher was removed and added
again since the last one, the node first gets the list without it, because roscpp must see the removal. The two are
some time apart, because rospy uses only the last of lists that arrive together, and takes an ending connection for a
present one. Other calls overtake a list that waits for this reason.
"""

import asyncio
import math
from collections import deque
from collections.abc import Awaitable, Callable
from contextlib import suppress
from dataclasses import dataclass, field
from typing import Generic, Protocol, TypeVar

import structlog

from appliance.base import clock
from appliance.master.graph.registry import Incarnation, Life, Registry
from appliance.policy.model import Address
from appliance.quotas.pool import Bounds, Pool, QuotaClass
from appliance.quotas.table import NODE_CALLS_UNDER_WAY, QUEUED_NODE_CALLS
from appliance.rpc.fair_queue import Turns
from appliance.rpc.xmlrpc_client import CallFailedError, RefusedError, XmlRpcClient
from roswire.uris import NodeUri, node_uri
from roswire.xmlrpc import FaultReceived, Value, XmlRpcLimits

# Call nodes that did not ask for it: which parameters a node cached under another master is unknown.
#
# 1. No other call to a node waits for these: they have connections and turns of their own, by host.
# 2. A node gets only the newest call of a key, and a pause between two rounds of calls.
# 3. A node that answers that it did not subscribe to a key gets none of that key any more (rospy). One that does not
#    answer several times gets none at all: its client library has no such call. roscpp answers each.

_UNASKED_APART_SECONDS = 0.2  # between two rounds of calls to a node
_AT_ONCE_OF_HOST = 8
_MAX_UNANSWERED = 5  # in a row; a node that hangs for some seconds still gets the newest value
_MAX_KEYS = 2_000  # of a node, that wait or are known not to be subscribed


class Named(Protocol):
    """A node; `key` tells apart its lives."""

    @property
    def key(self) -> str: ...

    @property
    def name(self) -> str: ...

    @property
    def host(self) -> Address: ...


N = TypeVar("N", bound=Named)
C = TypeVar("C")


@dataclass(slots=True)
class _Node(Generic[C]):
    waiting: dict[str, C] = field(default_factory=dict)  # by key, oldest first
    foreign: set[str] = field(default_factory=set)
    unanswered: int = 0
    worker: asyncio.Task[None] | None = None


class UnaskedCalls(Generic[N, C]):
    """Carries out calls with `call(node, call)`, which raises `CallFailedError`."""

    def __init__(self, call: Callable[[N, C], Awaitable[Value]]) -> None:
        self._call = call
        self._nodes: dict[str, _Node[C]] = {}
        self._turns: dict[Address, asyncio.Semaphore] = {}

    def push(self, node: N, key: str, call: C) -> None:
        known = self._nodes.setdefault(node.key, _Node())
        if key in known.foreign or known.unanswered >= _MAX_UNANSWERED:
            return
        if key not in known.waiting and len(known.waiting) >= _MAX_KEYS:
            del known.waiting[next(iter(known.waiting))]
        known.waiting[key] = call
        if known.worker is None:
            known.worker = asyncio.get_running_loop().create_task(self._work(node, known))

    def drop(self, node: N) -> None:
        known = self._nodes.pop(node.key, None)
        if known is not None and known.worker is not None:
            known.worker.cancel()

    def clear(self) -> None:
        """End the calls under way, and forget those that wait and all that is known of the nodes."""
        for known in self._nodes.values():
            if known.worker is not None:
                known.worker.cancel()
        self._nodes.clear()
        self._turns.clear()

    async def _work(self, node: N, known: _Node[C]) -> None:
        while known.waiting:
            for key in [*known.waiting]:
                await self._tell(node, known, key)
                if known.unanswered >= _MAX_UNANSWERED:
                    _log.info("a node does not take parameters that it did not ask for", node=node.name)
                    known.waiting.clear()
                    break
            await asyncio.sleep(_UNASKED_APART_SECONDS)
        known.worker = None

    async def _tell(self, node: N, known: _Node[C], key: str) -> None:
        async with self._turns.setdefault(node.host, asyncio.Semaphore(_AT_ONCE_OF_HOST)):
            call = known.waiting.pop(key, None)
            if call is None:
                return
            try:
                answer = await self._call(node, call)
            except CallFailedError:
                known.unanswered += 1
                known.waiting.setdefault(key, call)
                return
        known.unanswered = 0
        if isinstance(answer, list) and answer[:1] == [-1]:
            if len(known.foreign) >= _MAX_KEYS:
                known.foreign.clear()
            known.foreign.add(key)
        elif known.foreign:  # it has what is below this key
            known.foreign -= {one for one in known.foreign if one.startswith(f"{key.rstrip('/')}/")}


_log = structlog.get_logger()
MASTER_NAME = "/master"
_APART_SECONDS = 0.3  # between a list that removes a publisher and a list that adds it
_SHORTEST_WAIT = 0.001  # seconds: a timer that ends a little early does not make the worker spin
_CALL_BYTES = 200  # an empty call in Python's memory
_TEXT_BYTES = 60  # an empty text in Python's memory

ANSWER = XmlRpcLimits(body=16 << 10, elements=256, depth=4, string=16 << 10, parts=0)
LONG_ANSWER = XmlRpcLimits(body=256 << 10, elements=16_384, depth=4, string=16 << 10, parts=0)
"""For one answer at a time: a thousand connections of a node."""

_REUSES = frozenset({"requestTopic", "publisherUpdate", "paramUpdate"})  # a node may get each of these twice
_KEPT_SECONDS = 1.0  # between two rounds that close connections
_MAX_KEPT = 256  # addresses, each with one connection


class NodeApiClient:
    """Calls nodes; `timeout` is in seconds per call."""

    def __init__(self, registry: Registry, *, timeout: float) -> None:
        self._registry = registry
        self._timeout = timeout
        self._used: dict[
            NodeUri, XmlRpcClient
        ] = {}  # the clients with a connection that was used in this round
        self._unused: dict[NodeUri, XmlRpcClient] = {}  # in the round before, and not in this one
        self._round: asyncio.TimerHandle | None = None

    def client(
        self, incarnation: Incarnation, *, pool: int = 0, limits: XmlRpcLimits = ANSWER, patience: float = 1.0
    ) -> XmlRpcClient:
        """Return a client for the node's address, which another process may use now.

        `patience` multiplies the time of a call.
        """
        timeout = patience * self._timeout
        return XmlRpcClient(incarnation.call_uri, timeout=timeout, pool=pool, limits=limits)

    async def call(self, incarnation: Incarnation, method: str, *params: Value) -> Value:
        """Call a node. Raises `CallFailedError`; `RefusedError` for a shutdown if another node has the address."""
        if method == "shutdown" and incarnation.life is not Life.LIVE:
            uri = incarnation.call_uri
            there = next((other for other in self._registry.live() if other.call_uri == uri), None)
            if there is not None:
                where = node_uri(uri.host, uri.port, uri.path)
                raise RefusedError(f"{where} was not called: {there.name} has that address now")
        client = self._client_of(incarnation) if method in _REUSES else self.client(incarnation)
        return await client.call(method, *params)

    def _client_of(self, incarnation: Incarnation) -> XmlRpcClient:
        """Return a client with a kept connection (at most `_MAX_KEPT`): a starting node gets ten calls in a second."""
        uri = incarnation.call_uri
        client = self._used.get(uri) or self._unused.pop(uri, None)
        if client is None:
            if len(self._used) + len(self._unused) >= _MAX_KEPT:
                return self.client(incarnation)
            client = self.client(incarnation, pool=1)
        self._used[uri] = client
        if self._round is None:
            self._round = asyncio.get_running_loop().call_later(_KEPT_SECONDS, self._end_round)
        return client

    def _end_round(self) -> None:
        for client in self._unused.values():
            client.close()
        self._used, self._unused = {}, self._used
        later = asyncio.get_running_loop().call_later
        self._round = later(_KEPT_SECONDS, self._end_round) if self._unused else None


@dataclass(frozen=True, slots=True)
class NodeCall:
    """A method, and the parameters after the caller's name.

    `size` is the approximate size of the call in bytes, if known.
    """

    method: str
    parameters: tuple[Value, ...]
    size: int = 0

    @property
    def weight(self) -> int:
        if self.size:
            return self.size
        texts = [
            text for given in self.parameters for text in (given if isinstance(given, list) else [given])
        ]
        return _CALL_BYTES + sum(_TEXT_BYTES + len(text) for text in texts if isinstance(text, str))


@dataclass(slots=True, eq=False)
class _List:
    """The publishers of a topic that a node should know, and the removals that it does not know yet.

    A publisher that a sent list removed is not added before `free`.
    """

    topic: str
    weight: int = 0  # of the waiting call, as that of a NodeCall; 0: none waits
    wanted: tuple[str, ...] | None = None  # None: unknown; the answer to the registration had the list
    _untold: frozenset[str] | None = frozenset()  # removed since the last list that was sent; None: all
    _removed: frozenset[str] | None = frozenset()  # None: all
    _free: float = 0.0

    def want(self, publishers: tuple[str, ...], *, answered: bool = False) -> None:
        """`answered`: the node has this list already."""
        if self.wanted is None and not answered:
            self._untold = self._untold if publishers else None
        else:
            self.remove(frozenset(self.wanted or ()).difference(publishers))
        self.wanted = publishers

    def remove(self, publishers: frozenset[str]) -> None:
        self._untold = _union(self._untold, publishers)

    def next(self) -> tuple[str, ...]:
        """Return the list to send next: the wanted one, or first that without the publishers to remove."""
        return _without(self.wanted or (), self._untold)

    def wait(self) -> float:
        following = self.next()
        adds = len(_without(following, self._removed)) < len(following)
        return max(0.0, self._free - clock.now()) if adds else 0.0

    @property
    def call(self) -> NodeCall:
        return _call(self.topic, self.wanted or ())

    def take(self) -> "_Taken":
        taken = _Taken(self, self.next(), self._untold)
        self.weight, self._untold = 0, frozenset()
        return taken

    def sent(self, taken: "_Taken", *, arrived: bool) -> bool:
        """Note whether a list arrived; return whether a newer one must be sent."""
        if not arrived:
            self._untold = _union(self._untold, taken.removes)
            return False
        now = clock.now()
        if now >= self._free:
            self._removed = frozenset()
        if taken.removes is None or taken.removes:
            self._removed = _union(self._removed, taken.removes)
            self._free = now + _APART_SECONDS
        return taken.publishers != self.wanted


@dataclass(frozen=True, slots=True)
class _Taken:
    """A list on its way to a node, with the publishers whose removal it announces (None: all)."""

    list: _List
    publishers: tuple[str, ...]
    removes: frozenset[str] | None

    @property
    def call(self) -> NodeCall:
        return _call(self.list.topic, self.publishers)


def _call(topic: str, publishers: tuple[str, ...]) -> NodeCall:
    return NodeCall("publisherUpdate", (topic, list(publishers)))


def _union(some: frozenset[str] | None, others: frozenset[str] | None) -> frozenset[str] | None:
    return None if some is None or others is None else some | others


def _without(publishers: tuple[str, ...], removed: frozenset[str] | None) -> tuple[str, ...]:
    return () if removed is None else tuple(publisher for publisher in publishers if publisher not in removed)


@dataclass(slots=True)
class _Queue:
    """The calls and lists that wait for a node, oldest first, and the sum of their weights."""

    incarnation: Incarnation
    calls: deque[NodeCall | _List] = field(default_factory=deque)
    weight: int = 0
    more: asyncio.Event = field(default_factory=asyncio.Event)


class Delivery:
    """The queues of calls, one for each node. `troubled` is called for each call that is lost after some attempts.

    A queue holds at most `bound` calls, and `queued` limits the bytes of each host and of all hosts. Beyond a limit,
    an oldest call is dropped. Hosts take turns for the calls under way (`at_once`), so hanging nodes of one host do
    not delay calls to others.
    """

    def __init__(
        self,
        nodes: NodeApiClient,
        *,
        troubled: Callable[[Incarnation, NodeCall, str], None],
        quota_class: Callable[[Address], QuotaClass],
        bound: int = 10_000,
        queued: Bounds = QUEUED_NODE_CALLS.bounds,
        at_once: Bounds = NODE_CALLS_UNDER_WAY.bounds,
        tries: int = 4,
    ) -> None:
        self._nodes = nodes
        self._troubled = troubled
        self._bound = bound
        self._held: Pool[Address] = Pool(
            "bytes of calls that wait for nodes",
            queued,
            lambda _host: QuotaClass.REGISTERED,  # only registered nodes get calls
        )
        self._turns = Turns(at_once, quota_class)
        self._tries = tries
        self._silent = False
        self._queues: dict[str, _Queue] = {}
        self._workers: dict[str, asyncio.Task[None]] = {}
        self._lists: dict[str, dict[str, _List]] = {}  # by node and topic
        self._unasked = UnaskedCalls[Incarnation, NodeCall](
            lambda incarnation, call: nodes.client(incarnation).call(
                call.method, MASTER_NAME, *call.parameters
            )
        )

    @property
    def waiting(self) -> int:
        return sum(len(queue.calls) for queue in self._queues.values())

    @property
    def weight(self) -> int:
        return self._held.total

    def silence(self) -> None:
        """Send nothing more, and forget what waits, until `speak`: nodes get the lists of another master."""
        self._silent = True
        self.close()
        for queue in self._queues.values():
            self._held.give_back(queue.incarnation.host, queue.weight)
        self._queues.clear()
        self._lists.clear()

    def speak(self) -> None:
        self._silent = False

    def push(self, incarnation: Incarnation, call: NodeCall) -> None:
        if self._silent or incarnation.reached is False:
            return
        queue = self._queue(incarnation)
        queue.calls.append(call)
        self._weigh(queue, call.weight)
        self._start(queue)

    def push_unasked(self, incarnation: Incarnation, key: str, call: NodeCall) -> None:
        """Tell a node what it perhaps never asked for; `UnaskedCalls` says how."""
        if not self._silent and incarnation.reached is not False:
            self._unasked.push(incarnation, key, call)

    def list_of(self, incarnation: Incarnation, topic: str) -> tuple[str, ...] | None:
        """Return the list that the node has, or will get; None without one."""
        one = self._lists.get(incarnation.key, {}).get(topic)
        return None if one is None else one.wanted

    def push_list(self, incarnation: Incarnation, topic: str, publishers: tuple[str, ...]) -> None:
        if self._silent or incarnation.reached is False:
            return
        one = self._list(incarnation, topic)
        one.want(publishers)
        self._put(self._queue(incarnation), one)

    def answered(self, incarnation: Incarnation, topic: str, publishers: tuple[str, ...]) -> None:
        """Note that the answer to a registration had this list. It replaces a waiting list, which may be older."""
        self._list(incarnation, topic).want(publishers, answered=True)

    def remove_first(self, incarnation: Incarnation, topic: str, publishers: frozenset[str]) -> None:
        """Send the next list without these publishers first."""
        self._list(incarnation, topic).remove(publishers)

    async def ask(self, incarnation: Incarnation, method: str) -> Value:
        """Call a node once, in turn with the calls to other hosts, and return its answer. Raises `CallFailedError`."""
        await self._turns.enter(incarnation.host)
        try:
            return await self._nodes.client(incarnation, limits=LONG_ANSWER).call(method, MASTER_NAME)
        finally:
            self._turns.leave(incarnation.host)

    def drop_list(self, incarnation: Incarnation, topic: str) -> None:
        one = self._lists.get(incarnation.key, {}).pop(topic, None)
        if one is not None and one.weight:
            queue = self._queues[incarnation.key]
            queue.calls.remove(one)
            self._weigh(queue, -one.weight)

    def drop(self, incarnation: Incarnation) -> None:
        self._unasked.drop(incarnation)
        self._lists.pop(incarnation.key, None)
        queue = self._queues.pop(incarnation.key, None)
        if queue is not None:
            self._held.give_back(incarnation.host, queue.weight)

    def close(self) -> None:
        self._unasked.clear()
        for worker in self._workers.values():
            worker.cancel()

    def _list(self, incarnation: Incarnation, topic: str) -> _List:
        return self._lists.setdefault(incarnation.key, {}).setdefault(topic, _List(topic))

    def _queue(self, incarnation: Incarnation) -> _Queue:
        return self._queues.setdefault(incarnation.key, _Queue(incarnation))

    def _put(self, queue: _Queue, one: _List) -> None:
        before, one.weight = one.weight, one.call.weight
        self._weigh(queue, one.weight - before)
        if not before:
            queue.calls.append(one)
        self._start(queue)

    def _start(self, queue: _Queue) -> None:
        incarnation = queue.incarnation
        if len(queue.calls) > self._bound:
            self._lose(queue, f"more than {self._bound} calls wait for it")
        while why := self._held.refusal(incarnation.host, 0):
            self._lose(self._heaviest(incarnation.host), why)
        queue.more.set()
        if incarnation.key not in self._workers:
            worker = asyncio.get_running_loop().create_task(self._work(incarnation))
            self._workers[incarnation.key] = worker

    def _weigh(self, queue: _Queue, change: int) -> None:
        queue.weight += change
        if change > 0:
            self._held.charge(queue.incarnation.host, change)
        else:
            self._held.give_back(queue.incarnation.host, -change)

    def _heaviest(self, host: Address) -> _Queue:
        if self._held.held(host) <= self._held.bounds.host:
            host, _ = max(self._held.holders(), key=lambda holder: holder[1])
        queues = (queue for queue in self._queues.values() if queue.incarnation.host == host)
        return max(queues, key=lambda queue: queue.weight)

    def _lose(self, queue: _Queue, why: str) -> None:
        taken = self._take(queue, 0)
        if isinstance(taken, _Taken):
            taken.list.sent(taken, arrived=False)
        call = taken if isinstance(taken, NodeCall) else taken.call
        self._troubled(queue.incarnation, call, f"{why}; the oldest was dropped")

    def _next(self, queue: _Queue) -> tuple[int, float]:
        """Return the position of the call to send next, and the seconds before that."""
        soonest = 0, math.inf
        for position, call in enumerate(queue.calls):
            seconds = call.wait() if isinstance(call, _List) else 0.0
            if not seconds:
                return position, 0.0
            soonest = min(soonest, (position, seconds), key=lambda wait: wait[1])
        return soonest

    def _take(self, queue: _Queue, position: int) -> NodeCall | _Taken:
        call = queue.calls[position]
        del queue.calls[position]
        self._weigh(queue, -call.weight)
        return call.take() if isinstance(call, _List) else call

    async def _work(self, incarnation: Incarnation) -> None:
        try:
            while (queue := self._queues.get(incarnation.key)) is not None and queue.calls:
                position, seconds = self._next(queue)
                if seconds:
                    await _pause(queue.more, seconds)
                    continue
                taken = self._take(queue, position)
                if isinstance(taken, NodeCall):
                    await self._deliver(incarnation, taken)
                    continue
                arrived = await self._deliver(incarnation, taken.call)
                more = taken.list.sent(taken, arrived=arrived)
                if more and self._lists.get(incarnation.key, {}).get(taken.list.topic) is taken.list:
                    self._put(self._queue(incarnation), taken.list)
            self._queues.pop(incarnation.key, None)
        finally:
            self._workers.pop(incarnation.key, None)

    async def _deliver(self, incarnation: Incarnation, call: NodeCall) -> bool:
        """Return whether the node has taken the call, or rejected it."""
        pause = 0.1
        for attempt in range(self._tries):
            await self._turns.enter(incarnation.host)
            try:
                await self._nodes.call(incarnation, call.method, MASTER_NAME, *call.parameters)
            except CallFailedError as error:
                failure, heard = str(error), isinstance(error.__cause__, FaultReceived)
                if call.method == "shutdown":
                    return True  # a successful shutdown: a node often dies before it answers, or was already dead
            else:
                return True
            finally:
                self._turns.leave(incarnation.host)
            if attempt + 1 < self._tries:
                await asyncio.sleep(pause)
                pause *= 3
        if heard:
            _log.info("a node rejected a call", node=incarnation.name, call=call.method, why=failure)
        else:
            self._troubled(incarnation, call, failure)
        return heard


async def _pause(unless: asyncio.Event, seconds: float) -> None:
    unless.clear()
    with suppress(TimeoutError):
        async with asyncio.timeout(max(seconds, _SHORTEST_WAIT)):
            await unless.wait()
