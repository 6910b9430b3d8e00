"""Which nodes are still there: looked at every few seconds, and at once when something of a node breaks.

A node whose API refuses connections (twice in a row), is answered by another process than before, cannot be reached or
does not answer for `silent` seconds is *lost*: unregistered at ROSMaster as `rosnode cleanup` would, its registrations
kept as a shadow. A shadow whose API answers again gets them back, because a ROS 1 node never registers twice.
"""

import asyncio
import enum
import time
from collections.abc import Callable, Collection
from dataclasses import dataclass, field

import structlog

from appliance.configuration import settings
from appliance.master.endpoints.node_api import NodeApi
from appliance.master.endpoints.relay_control import RELAY_NAME
from appliance.master.graph.effects import NodeCall
from appliance.master.graph.graph import Graph
from appliance.master.graph.registry import Incarnation, Kind, Life, Registry
from appliance.master.graph.revocation import Revocation
from appliance.master.reconcile.enactor import Enactor
from appliance.policy.model import Address
from appliance.quotas.pool import Standing
from appliance.quotas.table import PROBES
from appliance.rpc.fair_queue import Turns
from appliance.rpc.xmlrpc_client import (
    BrokenOffError,
    CallFailedError,
    RefusedError,
    UnansweredError,
    UnreachedError,
)


class Presence(enum.Enum):
    """What came of an attempt to call a node."""

    GONE = "gone"  # it refuses connections, or cannot be reached
    SILENT = "silent"  # it takes connections and does not answer
    ANSWERS = "answers"


@dataclass(frozen=True, slots=True)
class Probe:
    """The answer to a contest's question; `patience` is seconds until a silent node is unregistered."""

    holder: Incarnation
    presence: Presence
    patience: float


_log = structlog.get_logger()
_REPLACED_SECONDS = 60.0
_IDLE_SECONDS = 30.0  # longer than a registering call can be on its way
_LOOK_AGAIN_SECONDS = 0.3


@dataclass(slots=True)
class Missed:
    """What a node could not be told: topics, and whether it were parameters; when it was told again, monotonic."""

    topics: set[str] = field(default_factory=set)
    parameters: bool = False
    made_up: float | None = None


class Watchlist:
    """Nodes that are to be looked at, for something of them broke: filled by who calls them, read by `Liveness`."""

    def __init__(self) -> None:
        self._nodes: dict[str, Incarnation] = {}
        self._missed: dict[str, Missed] = {}
        self._filled = asyncio.Event()

    def look_at(self, node: Incarnation) -> None:
        """Something of a node broke."""
        self._nodes[node.key] = node
        self._filled.set()

    def could_not_tell(self, node: Incarnation, call: NodeCall, why: str) -> None:
        """A node could not be told this: it is looked at, and told how things are once it answers."""
        _log.info("a node could not be told", node=node.name, call=call.method, why=why)
        missed = self._missed.setdefault(node.key, Missed())
        if call.method == "publisherUpdate":
            missed.topics.add(str(call.parameters[0]))
        missed.parameters |= call.method == "paramUpdate"
        self.look_at(node)

    async def filled(self) -> None:
        """Wait until there is a node to look at."""
        await self._filled.wait()

    def take(self) -> list[Incarnation]:
        """The nodes to look at, once."""
        self._filled.clear()
        nodes, self._nodes = self._nodes, {}
        return list(nodes.values())

    def to_make_up(self, node: Incarnation, interval: float) -> Missed | None:
        """What a node has missed; None within `interval` seconds after the last time: who answers may take nothing."""
        missed, now = self._missed.get(node.key), time.monotonic()
        if missed is None or (missed.made_up is not None and now - missed.made_up < interval):
            return None
        self._missed[node.key] = Missed(made_up=now)
        return missed

    def keep_only(self, keys: Collection[str]) -> None:
        """What other nodes have missed does not matter any more."""
        self._missed = {key: missed for key, missed in self._missed.items() if key in keys}


class Liveness:
    """Looks at nodes. Hosts take turns: nodes of one that answer nothing delay no look at another's."""

    def __init__(
        self,
        registry: Registry,
        graph: Graph,
        revocation: Revocation,
        enactor: Enactor,
        watchlist: Watchlist,
        *,
        nodes: NodeApi,
        settings: settings.Liveness,
        standing: Callable[[Address], Standing],
    ) -> None:
        self._registry = registry
        self._graph = graph
        self._revocation = revocation
        self._enactor = enactor
        self._watchlist = watchlist
        self._settings = settings
        self._nodes = nodes
        self._answered: dict[str, float] = {}
        # Of each node when it had registered last, and the process that answered then.
        self._processes: dict[str, tuple[float, int]] = {}
        self._looks: dict[str, asyncio.Task[None]] = {}
        self._turns = Turns(PROBES.bounds, standing)

    async def run(self) -> None:
        """Look at every incarnation every `interval` seconds, and at those on the watchlist, until cancelled."""
        async with asyncio.TaskGroup() as tasks:
            tasks.create_task(self._look_at_all())
            tasks.create_task(self._watch())

    async def _look_at_all(self) -> None:
        while True:
            await asyncio.sleep(self._settings.interval)
            known = self._registry.all()
            self._answered = {
                node.key: self._answered[node.key] for node in known if node.key in self._answered
            }
            keys = {node.key for node in known}
            self._processes = {key: given for key, given in self._processes.items() if key in keys}
            self._watchlist.keep_only(keys)
            for incarnation in known:
                self.look_at(incarnation)

    async def _watch(self) -> None:
        while True:
            await self._watchlist.filled()
            self.look_at_watched()

    def look_at_watched(self) -> None:
        """Look at the nodes on the watchlist now."""
        for incarnation in self._watchlist.take():
            self.look_at(incarnation)

    def look_at(self, incarnation: Incarnation) -> None:
        """Look at a node now (unless it is being looked at).

        The publisher of what monitors publish is control itself: it is there, and the firewall lets only the ROS Master
        call it.
        """
        if incarnation.key not in self._looks and not incarnation.of_monitors:
            task = asyncio.get_running_loop().create_task(self.look(incarnation))
            self._looks[incarnation.key] = task
            task.add_done_callback(lambda _done: self._looks.pop(incarnation.key, None))

    async def probe(self, incarnation: Incarnation) -> Probe:
        """Whether the node is there, asked now."""
        now = time.monotonic()
        since = self._answered.setdefault(incarnation.key, now)
        patience = max(0.0, self._settings.silent - (now - since)) + self._settings.interval
        try:
            await self._call(incarnation)
        except (RefusedError, UnreachedError):
            presence = Presence.GONE
        except (UnansweredError, BrokenOffError):
            presence = Presence.SILENT
        except CallFailedError:
            presence = Presence.ANSWERS
        else:
            presence = Presence.ANSWERS
        return Probe(incarnation, presence, patience)

    async def revive(self, incarnation: Incarnation) -> None:
        """A shadow registers: it is there again, and so is all it had."""
        self._answered[incarnation.key] = time.monotonic()
        self._processes.pop(incarnation.key, None)
        await self._bring_back(incarnation)

    async def _bring_back(self, incarnation: Incarnation) -> None:
        self._enactor.carry_out(self._graph.returned(incarnation))
        registrations = incarnation.in_order()
        self._enactor.carry_out(self._revocation.returned(incarnation))
        await self._enactor.put_back(incarnation, registrations)

    async def look(self, incarnation: Incarnation) -> None:
        """Ask a node whether it is there, and carry out what follows from its answer."""
        await self._turns.enter(incarnation.host)
        try:
            there, why = await self._ask(incarnation)
        finally:
            self._turns.leave(incarnation.host)
        if self._registry.by_key(incarnation.key) is not incarnation:
            return
        now = time.monotonic()
        since = self._answered.setdefault(incarnation.key, now)
        if there:
            self._answered[incarnation.key] = now
        if incarnation.life is Life.LIVE:
            refused = there is None
            if refused or (not there and now - since >= self._settings.silent):
                await self._lose(incarnation, why)
        else:
            await self._look_at_retired(incarnation, answered=bool(there), refused=there is None)
        if there and incarnation.life is Life.LIVE:
            await self._make_up(incarnation)

    async def _make_up(self, incarnation: Incarnation) -> None:
        """Tell a node what it has missed."""
        missed = self._watchlist.to_make_up(incarnation, self._settings.interval)
        if missed is None:
            return
        absent = {topic: publishers for _, topic, publishers in self._graph.absent([incarnation])}
        for topic in sorted(missed.topics):
            self._enactor.carry_out(self._graph.renew(incarnation, topic, absent.get(topic, ())))
        subscribed = [
            registration
            for registration in incarnation.registrations.values()
            if registration.kind is Kind.PARAMETER
        ]
        if missed.parameters and subscribed:
            await self._enactor.put_back(incarnation, subscribed)

    async def _ask(self, incarnation: Incarnation) -> tuple[bool | None, str]:
        """Whether it answers: True, False, or None when it refuses connections; and why."""
        for attempt in (1, 2):
            try:
                await self._call(incarnation)
            except RefusedError as error:
                if attempt == 2:
                    return None, f"{incarnation.name}: {error}"
                await asyncio.sleep(_LOOK_AGAIN_SECONDS)
            except CallFailedError as error:
                return False, f"{incarnation.name}: {error}"
            else:
                return True, ""
        return False, ""

    async def _call(self, incarnation: Incarnation) -> None:
        """Call the node. Raises `CallFailedError`; `RefusedError` also where another process has its port.

        Who registers anew at the same address may be another process: the one that answers from then on counts.
        """
        answer = await self._nodes.call(incarnation, "getPid", RELAY_NAME)
        match answer:
            case [_, _, int(process)]:
                pass
            case _:
                return
        when, before = self._processes.setdefault(incarnation.key, (incarnation.touched, process))
        if when != incarnation.touched:
            self._processes[incarnation.key] = incarnation.touched, process
        elif process != before:
            raise RefusedError(f"process {process} answers in the place of {before}")

    async def _lose(self, incarnation: Incarnation, why: str) -> None:
        if not incarnation.registrations and not incarnation.shelf:
            if time.monotonic() - incarnation.touched > _IDLE_SECONDS:
                self._forget(incarnation)
            return
        registrations = list(incarnation.registrations.values())
        self._enactor.carry_out(self._graph.lost(incarnation, why))
        await self._enactor.take_out(incarnation, registrations)

    async def _look_at_retired(self, incarnation: Incarnation, *, answered: bool, refused: bool) -> None:
        age = time.monotonic() - incarnation.changed
        if incarnation.life is Life.REPLACED:
            if refused or age > _REPLACED_SECONDS:
                self._forget(incarnation)
        elif age > self._settings.shadow:
            self._forget(incarnation)
        elif answered and self._registry.occupant(incarnation.name) is None:
            await self._bring_back(incarnation)

    def _forget(self, incarnation: Incarnation) -> None:
        self._enactor.carry_out(self._graph.forgotten(incarnation))
