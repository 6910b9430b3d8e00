"""Check nodes every few seconds, and at once after a failure.

A node is *lost* if its API refuses connections several times in a row, if another process answers at its address, or
after `silent` seconds without an answer. It then keeps its registrations as a shadow until its API answers again,
because a ROS 1 node never registers twice: for `shadow` seconds if its address refuses connections or another node has
its name, and otherwise for a day, because its machine may be suspended or out of reach. If a firewall shuts out the
appliance for a moment, all nodes of a host look lost, so a lost node is checked more often at first.

A node that only subscribes and was never reached, as behind NAT or a firewall, is there while it has a connection to a
relay. It is lost after `silent` seconds without one, and returns with the next: a refusal does not show that it ended.
No lost node is forgotten while it has a connection, because its client would not ask for another grant.
"""

import asyncio
import enum
from collections.abc import Callable, Collection
from dataclasses import KW_ONLY, InitVar, dataclass, field

import structlog

from appliance.base import clock
from appliance.configuration.settings import LivenessSection
from appliance.master.endpoints.delivery import NodeApiClient, NodeCall
from appliance.master.endpoints.relay_control import RELAY_NAME
from appliance.master.graph.graph import RosGraph
from appliance.master.graph.registry import Incarnation, Kind, Life, Registry
from appliance.master.graph.revocation import Revocation
from appliance.master.reconcile.subscribers import Subscribers
from appliance.policy.model import Address
from appliance.quotas.pool import QuotaClass
from appliance.quotas.table import PROBES
from appliance.rpc.fair_queue import Turns
from appliance.rpc.xmlrpc_client import (
    BrokenOffError,
    CallFailedError,
    NoRouteError,
    RefusedError,
    UnansweredError,
    UnreachedError,
)
from roswire.xmlrpc import FaultReceived


class Presence(enum.Enum):
    """The result of an attempt to call a node."""

    GONE = "gone"  # the node refuses connections, or cannot be reached
    SILENT = "silent"  # the node accepts connections but does not answer
    ANSWERS = "answers"


@dataclass(frozen=True, slots=True)
class Probe:
    """The probe of the holder of a name. A silent node is unregistered after `patience` seconds."""

    holder: Incarnation
    presence: Presence
    patience: float


_log = structlog.get_logger()
_REPLACED_SECONDS = 60.0
_IDLE_SECONDS = 30.0  # longer than any registering call takes
_LOOK_AGAIN_SECONDS = 0.3
_AWAY_SECONDS = 86_400.0
_RECENT_SECONDS = 30.0  # after a loss, during which the node is checked every `RECENTLY_LOST_SECONDS`
RECENTLY_LOST_SECONDS = 0.5
_MADE_UP_SECONDS = 1.0  # between two repetitions for a node that keeps failing


@dataclass(slots=True)
class MissedUpdates:
    """The updates that did not reach a node. `made_up` is the monotonic time when they were last repeated."""

    topics: set[str] = field(default_factory=set)
    parameters: bool = False
    made_up: float | None = None


class Watchlist:
    """The nodes to check because of a failure."""

    def __init__(self) -> None:
        self._nodes: dict[str, Incarnation] = {}
        self._missed: dict[str, MissedUpdates] = {}
        self._filled = asyncio.Event()

    def look_at(self, node: Incarnation) -> None:
        self._nodes[node.key] = node
        self._filled.set()

    def could_not_tell(self, node: Incarnation, call: NodeCall, why: str) -> None:
        """Check a node that a call did not reach; it gets the present state once it answers."""
        _log.info("a call to a node failed", node=node.name, call=call.method, why=why)
        missed = self._missed.setdefault(node.key, MissedUpdates())
        if call.method == "publisherUpdate":
            missed.topics.add(str(call.parameters[0]))
        missed.parameters |= call.method == "paramUpdate"
        self.look_at(node)

    def cut_off(self, subscriber: Incarnation, topic: str) -> None:
        """Check a subscriber that lost its connection; once it answers, it gets the list of publishers again."""
        self._missed.setdefault(subscriber.key, MissedUpdates()).topics.add(topic)
        self.look_at(subscriber)

    def returned(self, node: Incarnation) -> None:
        self._missed[node.key] = MissedUpdates(set(node.resources(Kind.SUBSCRIPTION)))

    async def until_filled(self) -> None:
        await self._filled.wait()

    def take(self) -> list[Incarnation]:
        self._filled.clear()
        nodes, self._nodes = self._nodes, {}
        return list(nodes.values())

    def has_missed(self, node: Incarnation) -> bool:
        missed = self._missed.get(node.key)
        return missed is not None and bool(missed.topics or missed.parameters)

    def to_make_up(self, node: Incarnation) -> MissedUpdates | None:
        """Return and clear the missed updates, unless some were repeated in the last `_MADE_UP_SECONDS`."""
        missed, now = self._missed.get(node.key), clock.now()
        if missed is None or (missed.made_up is not None and now - missed.made_up < _MADE_UP_SECONDS):
            return None
        self._missed[node.key] = MissedUpdates(made_up=now)
        return missed

    def keep_only(self, keys: Collection[str]) -> None:
        self._missed = {key: missed for key, missed in self._missed.items() if key in keys}


@dataclass(eq=False)
class Liveness:
    """Checks nodes. Hosts take turns, so that hanging nodes of one host do not delay checks of others.

    A node that refuses `refusals` connections in a row is lost, unless the robot's firewalls may shut out this one of
    two appliances (`shut_out`). `own_silent()` is called when rosout, the appliance's own node, hangs. `connects`
    returns whether a name of a host has a connection to a relay.
    """

    registry: Registry
    graph: RosGraph
    revocation: Revocation
    subscribers: Subscribers
    watchlist: Watchlist
    _: KW_ONLY
    nodes: NodeApiClient
    settings: LivenessSection
    quota_class: InitVar[Callable[[Address], QuotaClass]]
    refusals: int
    shut_out: Callable[[], bool]
    connects: Callable[[Address, str], bool]
    own_silent: Callable[[], object]

    def __post_init__(self, quota_class: Callable[[Address], QuotaClass]) -> None:
        self._answered: dict[str, float] = {}
        # For each node: the time of its last registration, and the process id that first answered afterwards.
        self._processes: dict[str, tuple[float, int]] = {}
        self._checks: dict[str, asyncio.Task[None]] = {}
        self._turns = Turns(PROBES.bounds, quota_class)

    async def run(self) -> None:
        async with asyncio.TaskGroup() as tasks:
            tasks.create_task(self._look_at_all())
            tasks.create_task(self._look_at_lost())
            tasks.create_task(self._watch())

    async def _look_at_all(self) -> None:
        while True:
            await asyncio.sleep(self.settings.interval)
            known = self.registry.all()
            self._answered = {
                node.key: self._answered[node.key] for node in known if node.key in self._answered
            }
            keys = {node.key for node in known}
            self._processes = {key: given for key, given in self._processes.items() if key in keys}
            self.watchlist.keep_only(keys)
            for incarnation in known:
                self.look_at(incarnation)

    async def _look_at_lost(self) -> None:
        while True:
            await asyncio.sleep(RECENTLY_LOST_SECONDS)
            now = clock.now()
            for incarnation in self.registry.all():
                if incarnation.life is Life.SHADOW and now - incarnation.changed < _RECENT_SECONDS:
                    self.look_at(incarnation)

    async def _watch(self) -> None:
        while True:
            await self.watchlist.until_filled()
            self.look_at_watched()

    def look_at_watched(self) -> None:
        for incarnation in self.watchlist.take():
            self.look_at(incarnation)

    def look_at(self, incarnation: Incarnation) -> None:
        """Start a check, unless one is under way.

        The publisher for monitors is control itself, and only the ROS master may call it.
        """
        if incarnation.key not in self._checks and not incarnation.of_monitors:
            task = asyncio.get_running_loop().create_task(self.look(incarnation))
            self._checks[incarnation.key] = task
            task.add_done_callback(lambda _done: self._checks.pop(incarnation.key, None))

    async def probe(self, incarnation: Incarnation) -> Probe:
        now = clock.now()
        since = self._answered.setdefault(incarnation.key, now)
        patience = max(0.0, self.settings.silent - (now - since)) + self.settings.interval
        try:
            await self._call(incarnation)
        except (RefusedError, UnreachedError):
            presence = Presence.SILENT if self.shut_out() else Presence.GONE
        except (UnansweredError, BrokenOffError):
            presence = Presence.SILENT
        except CallFailedError:
            presence = Presence.ANSWERS
        else:
            presence = Presence.ANSWERS
        if self._only_connects(incarnation):
            presence = Presence.ANSWERS
        return Probe(incarnation, presence, patience)

    def _only_listens(self, incarnation: Incarnation) -> bool:
        return incarnation.only_listens and not incarnation.reached

    def _only_connects(self, incarnation: Incarnation) -> bool:
        return self._only_listens(incarnation) and self.connects(incarnation.host, incarnation.name)

    def revive(self, incarnation: Incarnation) -> None:
        self._answered[incarnation.key] = clock.now()
        self._processes.pop(incarnation.key, None)
        self._bring_back(incarnation)

    def _bring_back(self, incarnation: Incarnation) -> None:
        self.graph.returned(incarnation)
        self.revocation.returned(incarnation)
        self.watchlist.returned(incarnation)
        # Its publishers may return with it, so the lists follow a little later.
        asyncio.get_running_loop().call_later(RECENTLY_LOST_SECONDS, self.look_at, incarnation)

    async def look(self, incarnation: Incarnation) -> None:
        await self._turns.enter(incarnation.host)
        try:
            there, why, ended = await self._ask(incarnation)
        finally:
            self._turns.leave(incarnation.host)
        if self.registry.by_key(incarnation.key) is not incarnation:
            return
        now = clock.now()
        since = self._answered.setdefault(incarnation.key, now)
        if there:
            self._answered[incarnation.key] = now
            self.reached(incarnation)
        refused = there is None and not self.shut_out()
        ended = refused and ended and not self._only_listens(incarnation)
        connected = not there and self._only_connects(incarnation)
        if connected:
            self._answered[incarnation.key] = now
            incarnation.reached = False
        if incarnation.life is not Life.LIVE:
            self._look_at_retired(incarnation, answered=there or connected, refused=refused, ended=ended)
        elif incarnation.reached is False:
            if not connected and now - max(since, incarnation.touched) >= self.settings.silent:
                self._lose(incarnation, f"{why}, and it has no connection to a relay")
        elif refused or (not there and now - since >= self.settings.silent):
            if incarnation.own and not refused:  # one that refuses has ended, and is started again already
                self.own_silent()
            self._lose(incarnation, why)
        elif there:
            self._make_up(incarnation)
        elif there is None or self.watchlist.has_missed(incarnation):
            asyncio.get_running_loop().call_later(RECENTLY_LOST_SECONDS, self.look_at, incarnation)

    def reached(self, incarnation: Incarnation) -> None:
        """Note that a node can be called; its next check makes up for what it missed."""
        if incarnation.reached is False:
            self.watchlist.returned(incarnation)
        incarnation.reached = True

    def _make_up(self, incarnation: Incarnation) -> None:
        missed = self.watchlist.to_make_up(incarnation)
        if missed is None:
            return
        absent = {topic: publishers for _, topic, publishers in self.subscribers.absent([incarnation])}
        for topic in sorted(missed.topics):
            self.subscribers.renew(incarnation, topic, absent.get(topic, ()))
        if missed.parameters:
            self.subscribers.tell_parameters(incarnation)

    async def _ask(self, incarnation: Incarnation) -> tuple[bool | None, str, bool]:
        """Return whether the node answers (None: it cannot be called), why not, and whether its process has ended."""
        for attempt in range(1, self.refusals + 1):
            try:
                await self._call(incarnation)
            except RefusedError as error:
                if attempt == self.refusals:
                    return None, f"{incarnation.name}: {error}", not isinstance(error, NoRouteError)
                await asyncio.sleep(_LOOK_AGAIN_SECONDS)
            except CallFailedError as error:
                # A fault is an answer: a small client library may lack getPid.
                return isinstance(error.__cause__, FaultReceived), f"{incarnation.name}: {error}", False
            else:
                return True, "", False
        return False, "", False

    async def _call(self, incarnation: Incarnation) -> None:
        """Call a node. Raises `CallFailedError`: as `RefusedError` if another process answers at the node's port.

        After each registration, the first process that answers becomes the expected one.
        """
        answer = await self.nodes.call(incarnation, "getPid", RELAY_NAME)
        match answer:
            case [_, _, int(process)]:
                pass
            case _:
                return
        when, before = self._processes.setdefault(incarnation.key, (incarnation.touched, process))
        if when != incarnation.touched:
            self._processes[incarnation.key] = incarnation.touched, process
        elif process != before:
            raise RefusedError(f"process {process} answers in place of {before}")

    def _lose(self, incarnation: Incarnation, why: str) -> None:
        if not incarnation.registrations and not incarnation.shelf:
            if clock.now() - incarnation.touched > _IDLE_SECONDS:
                self._forget(incarnation)
            return
        self.graph.lost(incarnation, why)

    def _look_at_retired(
        self, incarnation: Incarnation, *, answered: bool, refused: bool, ended: bool
    ) -> None:
        now, key = clock.now(), incarnation.key
        if incarnation.life is Life.REPLACED:
            if refused or now - incarnation.changed > _REPLACED_SECONDS:
                self._forget(incarnation)
            return
        replaced = self.registry.occupant(incarnation.name) is not None
        if answered and not replaced:
            self._bring_back(incarnation)
            return
        since = incarnation.changed if replaced else max(incarnation.changed, self._answered[key])
        shadow = self.settings.shadow if ended or replaced else max(self.settings.shadow, _AWAY_SECONDS)
        if now - since > shadow and not replaced and self.connects(incarnation.host, incarnation.name):
            self._answered[key] = now
        elif now - since > shadow:
            self._forget(incarnation)

    def _forget(self, incarnation: Incarnation) -> None:
        self.graph.forgotten(incarnation)
