"""Histories of RVMaster by seed: its real parts, with models of nodes, relay and `rosmaster`.

    .venv/bin/python -m tests.support.histories SEED            # one history, with each of its events
    .venv/bin/python -m tests.support.histories --many NUMBER   # this many seeds; lists those that break a promise
    .venv/bin/python -m tests.support.histories --mutants NUMBER   # faults of the core, and the first that finds each

Time is virtual: it advances when nothing else is left to do, so that a history of minutes takes milliseconds, and a
seed determines the order of events. Each call, delivery and order to the relay takes a random time. Faults: nodes die,
hang, come back, and are replaced under their name; `rosmaster` and the relay restart; control dies between two steps
and restarts with its stored state; calls to `rosmaster` break off before or after their effect; policies are
reloaded. After the last fault there is time to settle.

Nodes behave as in ROS: they take a list of publishers, ask each new one, connect to the given port, retry broken
connections, and end on a shutdown request. They get no update of a topic while their own registering call for it is
in progress: this race exists with a plain ROS master as well.
"""

# ruff: noqa: D102  the models have the methods of the classes that they replace

import asyncio
import contextlib
import logging
import os
import selectors
import sys
from collections import deque
from collections.abc import Awaitable, Callable, Iterator
from dataclasses import dataclass, field
from itertools import count
from random import Random
from types import SimpleNamespace
from typing import Any, cast

import structlog

from appliance.channel import messages
from appliance.master.caller import Answer
from appliance.master.endpoints.delivery import Delivery
from appliance.master.endpoints.relay_control import RelayControl
from appliance.master.endpoints.traffic import RelayTraffic
from appliance.master.graph import graph as graph_module
from appliance.master.graph.effects import (
    Effect,
    PlaceGrant,
    PlaceNode,
    PlaceResource,
    RevokeGrant,
    SaveGrant,
)
from appliance.master.graph.graph import RosGraph
from appliance.master.graph.registry import Incarnation, Kind, Registry, SaveRegistration
from appliance.master.graph.revocation import Revocation
from appliance.master.reconcile import arrivals as arrivals_module
from appliance.master.reconcile import liveness as liveness_module
from appliance.master.reconcile.arrivals import Arrivals
from appliance.master.reconcile.enactor import Enactor, restore
from appliance.master.reconcile.reconciler import Reconciler
from appliance.master.reconcile.reminders import Reminders
from appliance.policy.policy import Policy
from appliance.policy.policy_compiler import compile_policy
from appliance.quotas.pool import QuotaClass
from appliance.rpc.xmlrpc_client import BrokenOffError, RefusedError, UnansweredError
from appliance.specifications.allocation import Allocation
from appliance.store.state_file import IncarnationRow, PermissionRow, RegistrationRow, StateStore
from roswire.xmlrpc import Value
from tests.support.control_parts import OPEN, POLICY, ControlParts, HiddenMaster, Inner
from tests.support.idle import idle, idle_class

TOPICS = ("/a", "/b")
HOSTS = ("10.0.0.1", "10.0.0.2", "10.0.0.3")
NAMES = ("/one", "/two", "/three")
POLICIES: dict[str, tuple[str, dict[str, set[str]], dict[str, set[str]]]] = {
    "open": (OPEN, {}, {}),
    "/a is published by 1": (POLICY.format("/a = 10.0.0.1\n", ""), {"/a": {HOSTS[0]}}, {}),
    "/a is subscribed to by 2 and 3": (
        POLICY.format("", "/a = 10.0.0.2, 10.0.0.3\n"), {}, {"/a": {HOSTS[1], HOSTS[2]}},
    ),
    "/b is nobody's": (POLICY.format("/b =\n", "/b =\n"), {"/b": set()}, {"/b": set()}),
}  # fmt: skip
"""Policies by name: the text, and as an oracle the hosts that may publish and subscribe to each topic it names."""

_SETTLES = 150.0  # seconds
_RELAY_PORTS = 30_000
_NOBODY_KNOWS = "not come back", "does not answer"  # in the answer to a call that may have been carried out


class BrokenPromiseError(AssertionError):
    """A history broke a promise."""


class VirtualLoop(asyncio.SelectorEventLoop):
    """An event loop with virtual time, which advances only when nothing else is left to do."""

    def __init__(self) -> None:
        self.now = 1000.0
        super().__init__(_Jumping(self))

    def time(self) -> float:
        """Return this loop's time in seconds."""
        return self.now


class _Jumping(selectors.SelectSelector):
    def __init__(self, loop: VirtualLoop) -> None:
        super().__init__()
        self._loop = loop

    def select(self, timeout: float | None = None) -> Any:
        """Select among files that never have events."""
        if timeout is None:
            raise BrokenPromiseError("deadlock: every task waits")
        self._loop.now += max(timeout, 0.0)
        return []


@dataclass(eq=False)
class Subscription:
    """A node's state for a topic: its list of publishers, and its connections to them with the entry used for each."""

    known: list[str] = field(default_factory=list)
    ways: dict[str, str] = field(default_factory=dict)  # URI to the key behind the port that the node got


@dataclass(eq=False)
class Process:
    """A running node."""

    name: str
    host: str
    port: int
    alive: bool = True
    answers: bool = True
    superseded: bool = False
    publishes: set[str] = field(default_factory=set)
    subscribes: dict[str, Subscription] = field(default_factory=dict)
    calling: set[tuple[str, str]] = field(default_factory=set)

    @property
    def api(self) -> str:
        """Return the node's URI."""
        return f"http://{self.host}:{self.port}/"


class Relay:
    """One life of the relay: its orders, in sequence, and its connections."""

    def __init__(self, world: "World") -> None:
        self._world = world
        self.orders: deque[messages.Message] = deque()
        self.nodes: set[str] = set()
        self.publications: set[tuple[str, str]] = set()
        self.grants: set[tuple[str, str, str, str]] = set()
        self.connections: dict[tuple[str, str, str, str], Process] = {}
        self._restated = True
        self.stirred = asyncio.Event()

    def attach(self, *_given: object) -> None:
        """Do nothing."""

    def close(self) -> None:
        """Do nothing."""

    def send(self, message: messages.Message, _descriptors: tuple[int, ...] = (), **_when: bool) -> None:
        if isinstance(message, messages.GrantInstalled):
            self._world.check_grant(message.topic, message.host, message.caller_id)
        self.orders.append(message)
        self.stirred.set()

    def carry_out(self) -> None:
        """Carry out the next order."""
        match self.orders.popleft():
            case messages.StateBegan():
                self._restated = False
                self.nodes, self.publications, self.grants = set(), set(), set()
            case messages.NodePlaced(key):
                self.nodes.add(key)
            case messages.NodeWithdrawn(key):
                self.nodes.discard(key)
                self.publications = {one for one in self.publications if one[0] != key}
                self.grants = {one for one in self.grants if one[0] != key}
            case messages.PublicationPlaced(key, topic):
                self.publications.add((key, topic))
            case messages.PublicationWithdrawn(key, topic):
                self.publications.discard((key, topic))
            case messages.GrantInstalled(key, topic, host, name):
                self.grants.add((key, topic, host, name))
            case messages.GrantRevoked(key, topic, host, name):
                self.grants.discard((key, topic, host, name))
            case messages.StateEnded():
                self._restated = True
        if self._restated:
            self.connections = {row: one for row, one in self.connections.items() if self.lets_in(row)}

    def lets_in(self, row: tuple[str, str, str, str]) -> bool:
        """Whether a subscriber may have a topic of a publisher."""
        return row in self.grants and row[:2] in self.publications and row[0] in self.nodes


class Kept(idle_class(StateStore)):  # type: ignore[misc]  # a class made at run time
    """The state store, which outlives control."""

    def __init__(self) -> None:
        self.nodes: dict[str, IncarnationRow] = {}
        self.registrations: dict[tuple[str, str, str], RegistrationRow] = {}
        self.grants: dict[PermissionRow, None] = {}

    def save_incarnation(self, row: IncarnationRow) -> None:
        self.nodes[row.key] = row

    def forget_incarnation(self, key: str) -> None:
        self.nodes.pop(key, None)
        self.registrations = {at: row for at, row in self.registrations.items() if row.key != key}
        self.grants = {row: None for row in self.grants if row.key != key}

    def save_registration(self, row: RegistrationRow) -> None:
        self.registrations[row.key, row.kind, row.resource] = row

    def remove_registration(self, key: str, kind: str, resource: str) -> None:
        self.registrations.pop((key, kind, resource), None)

    def load_registry(self) -> tuple[list[IncarnationRow], list[RegistrationRow]]:
        return [*self.nodes.values()], sorted(self.registrations.values(), key=lambda row: row.ordinal)

    def save_permission(self, row: PermissionRow) -> None:
        self.grants[row] = None

    def remove_permission(self, row: PermissionRow) -> None:
        self.grants.pop(row, None)

    def permissions(self) -> list[PermissionRow]:
        return [*self.grants]


class Master(HiddenMaster):
    """A model of `rosmaster`: each call takes time, and some calls break off during faults."""

    def __init__(self, world: "World") -> None:
        super().__init__()
        self._world = world

    async def call(self, method: str, *params: Value) -> Value:
        await self._world.some_time()
        breaks = self._world.faulty and self._world.rng.random() < 0.04
        if breaks and self._world.rng.random() < 0.5:
            raise RefusedError("nobody is there")
        answer = await super().call(method, *params)
        await self._world.some_time()
        if breaks:
            raise BrokenOffError("the connection ended")
        return answer

    def carry_out(self, method: str, *params: Value) -> Answer:
        if (
            method in ("registerPublisher", "registerSubscriber")
            and self.nodes.get(str(params[0]), params[-1]) != params[-1]
        ):
            for table in self.tables.values():  # as `rosmaster` does with a node that has another URI
                for holders in table.values():
                    holders.pop(str(params[0]), None)
        return super().carry_out(method, *params)


class Reach:
    """Calls to the node of an incarnation."""

    def __init__(self, world: "World", incarnation: Incarnation) -> None:
        self._world = world
        self._incarnation = incarnation

    async def call(self, method: str, *params: Value) -> Value:
        await self._world.some_time()
        uri = self._incarnation.call_uri
        process = next(
            (
                one
                for one in self._world.processes
                if one.alive and (one.host, one.port) == (uri.host, uri.port)
            ),
            None,
        )
        if process is None:
            raise RefusedError("nobody is there")
        if not process.answers:
            await asyncio.sleep(3.0)
            raise UnansweredError("no answer")
        if method == "publisherUpdate":
            await self._world.update(
                process, str(params[1]), [str(one) for one in cast(list[Value], params[2])]
            )
        elif method == "shutdown":
            self._world.ends(process)
        return [1, "", 1]


class _Faces(Inner):
    """Proxy endpoints that open at once."""

    async def open(self, _incarnation: Incarnation) -> None:
        """Do nothing."""


class Control(ControlParts):
    """One life of control."""

    def __init__(self, world: "World") -> None:
        self.world = world
        super().__init__(silent=20.0)
        self.reminders = Reminders(self.registry, self.graph, self.enactor)

    def surround(self) -> None:
        world = self.world
        self.current = world.policy_in_force
        self.hidden, self.store = world.master, cast(Any, world.kept)
        cast(Any, self.nodes).client = lambda incarnation: Reach(world, incarnation)
        delivery = Delivery(
            self.nodes,
            troubled=self.watchlist.could_not_tell,
            quota_class=lambda _host: QuotaClass.REGISTERED,
        )
        self.deliveries = cast(Any, delivery)
        self.faces = _Faces(self.registry)
        self.relay = cast(
            Any,
            RelayControl(
                self.registry, self.grants, cast(Any, _Ports()), self.nodes, idle(RelayTraffic),
                allocation=Allocation(1),
                policy=lambda: self.current,
                monitors=cast(Any, _Monitors), broken=self.watchlist.look_at, own_header=None, own_call=cast(Any, None),
            ),
        )  # fmt: skip
        self.grants.used = world.used

    def arrivals(self) -> Any:
        return Arrivals(
            self.registry, self.graph, self.enactor, self.liveness, places=cast(Any, self.world),
            faces=cast(Any, self.faces), addresses=cast(Any, self.addresses),
        )  # fmt: skip

    async def begin(self) -> None:
        """Start as the process does: load the stored state, then start the loops."""
        restore(self.registry, cast(Any, self.world.kept))
        self.enactor.carry_out(self.grants.restore(self.world.kept.permissions()))
        self.enactor.carry_out(self.revocation.policy_changed(self.current, self.current))
        self.attach()
        self.world.task(self.reconciler.run())
        self.world.task(self.liveness.run())

    def attach(self) -> None:
        """Attach the relay in its present state."""
        cast(Any, self.relay).attach(0, self.world.relay)
        self.enactor.carry_out(self.graph.tell_everybody())
        self.reminders.begin()


class World:
    """The whole state of one history."""

    def __init__(
        self, seed: int, loop: VirtualLoop, say: Callable[[str], object] = lambda _line: None
    ) -> None:
        self.rng = Random(seed)  # noqa: S311  histories, no secrets
        self.loop = loop
        self._say = say
        self.faulty = True
        self.policy = "open"
        self.processes: list[Process] = []
        self.kept, self.relay = Kept(), Relay(self)
        self.master = Master(self)
        self._ports, self._node_ports = count(20_001), count(40_001)
        self._tasks: dict[asyncio.Task[Any], None] = {}
        self.errors: list[Exception] = []
        self.control = Control(self)

    # --- services for the models ---

    @property
    def policy_in_force(self) -> Policy:
        """Return the policy of this life of control."""
        return compile_policy(POLICIES[self.policy][0], file="policy")

    def open(self, _host: object) -> tuple[int, int]:
        """Open ports for a node, as `Places` does."""
        return next(self._ports), next(self._ports)

    async def some_time(self) -> None:
        """Wait for a random time, as for a message on its way."""
        await asyncio.sleep(self.rng.choice((0.0, 0.0, 0.001, 0.01, 0.1)))

    def used(self) -> set[PermissionRow]:
        """Note grants that a connection uses."""
        return {
            PermissionRow(key, "topic", topic, host, name)
            for key, topic, host, name in self.relay.connections
        }

    def say(self, line: str) -> None:
        """Log an event."""
        self._say(f"{self.loop.now - 1000.0:9.3f}  {line}")

    def task(self, work: Awaitable[Any]) -> None:
        """Start a task that runs until control or the history ends."""
        task = asyncio.ensure_future(work)
        self._tasks[task] = None
        task.add_done_callback(self._done)

    def _done(self, task: asyncio.Task[Any]) -> None:
        self._tasks.pop(task, None)
        if not task.cancelled() and task.exception() is not None:
            self.errors.append(cast(Exception, task.exception()))

    # --- nodes ---

    def ends(self, process: Process) -> None:
        """End a process and its connections."""
        if process.alive:
            self.say(f"{process.name} at {process.host}:{process.port} ends")
        process.alive = False
        connections = self.relay.connections
        self.relay.connections = {row: one for row, one in connections.items() if one is not process}

    def call(self, process: Process, method: str, topic: str) -> None:
        """Start a registering call of a node, and repeat it if its outcome is unknown."""
        if (method, topic) not in process.calling:
            process.calling.add((method, topic))
            self.say(f"{process.name} at {process.host}:{process.port} {method} {topic}")
            self.task(self._call(process, method, topic))

    async def _call(self, process: Process, method: str, topic: str) -> None:
        kind = ["std_msgs/String"] if method.startswith("register") else []
        given = (process.name, topic, *kind, process.api)
        while process.alive:
            await self.some_time()
            answer = cast(list[Any], await self.control.ask(method, *given, host=process.host))
            if answer[0] == 1 and kind:
                self._takes_the_name(process)
            await self.some_time()
            if answer[0] == 1 or not any(text in str(answer[1]) for text in _NOBODY_KNOWS):
                break
        process.calling.discard((method, topic))
        self.say(f"  {process.name} is answered {method} {topic}: {answer[0]}")
        if not process.alive or not method.startswith("register"):
            return
        if answer[0] != 1:
            if method == "registerPublisher":
                process.publishes.discard(topic)
            else:
                process.subscribes.pop(topic, None)
            self.say(f"{process.name} at {process.host}:{process.port}: {answer[1]}")
        elif method == "registerSubscriber":
            await self.update(process, topic, answer[2])

    def _takes_the_name(self, process: Process) -> None:
        """Mark the node that had this name as superseded. If it hangs it goes on; the next caller decides its state."""
        for other in self.processes:
            if other.name == process.name and other is not process:
                other.superseded = True

    async def update(self, process: Process, topic: str, uris: list[str]) -> None:
        """Send a node the publishers of a topic."""
        while process.alive and ("registerSubscriber", topic) in process.calling:
            await asyncio.sleep(0.01)
        self.see(process, uris)
        subscription = process.subscribes.get(topic)
        if subscription is None or not process.alive:
            return
        self.say(f"  {process.name} is told {topic} {uris}")
        uris = [uri for uri in uris if uri != process.api]  # its own publications stay within the process
        new = [uri for uri in uris if uri not in subscription.known]
        for uri in subscription.known:
            if uri not in uris:
                self.disconnect(process, topic, subscription.ways.pop(uri, ""))
        subscription.known = list(uris)
        for uri in new:
            self.task(self._request(process, topic, subscription, uri))

    async def _request(self, process: Process, topic: str, subscription: Subscription, uri: str) -> None:
        await self.some_time()
        target = next((one for one in self.control.registry.all() if one.outer_uri("10.0.0.1") == uri), None)
        answer: Value = [0]
        if target is not None:
            answer = await self.control.ask(
                "requestTopic", process.name, topic, [["TCPROS"]], host=process.host, target=target
            )
        await self.some_time()
        self.say(f"  {process.name} asked {uri} for {topic}: {answer!r}")
        if uri in subscription.known:
            if target is not None and cast(list[Any], answer)[0] == 1:
                subscription.ways[uri] = target.key
            else:
                subscription.known.remove(uri)

    def disconnect(self, process: Process, topic: str, key: str) -> None:
        """Close a connection of a node."""
        self.relay.connections.pop((key, topic, process.host, process.name), None)

    async def connecting(self) -> None:
        """Connect nodes to their lists of publishers, and retry broken connections."""
        while True:
            await asyncio.sleep(0.5)
            for process in self.processes:
                for topic, subscription in process.subscribes.items():
                    for key in subscription.ways.values():
                        row = (key, topic, process.host, process.name)
                        if process.alive and process.answers and self.relay.lets_in(row):
                            self.relay.connections[row] = process

    async def carrying(self, relay: Relay) -> None:
        """Carry out the orders of the relay."""
        while relay is self.relay:
            await relay.stirred.wait()
            relay.stirred.clear()
            while relay.orders:
                await self.some_time()
                for _ in range(min(len(relay.orders), self.rng.randrange(1, 9))):
                    relay.carry_out()

    # --- events ---

    def _living(self) -> Process | None:
        there = [one for one in self.processes if one.alive]
        return self.rng.choice(there) if there else None

    def starts(self) -> None:
        """Start a node; with the name of another node it replaces that one."""
        name, host = self.rng.choice(NAMES), self.rng.choice(HOSTS)
        process = Process(name, host, next(self._node_ports))
        self.processes.append(process)
        for topic in TOPICS:
            if self.rng.random() < 0.5:
                self.publishes(process, topic)
            if self.rng.random() < 0.5:
                self.subscribes(process, topic)

    def publishes(self, process: Process, topic: str) -> None:
        """Make a node publish a topic."""
        process.publishes.add(topic)
        self.call(process, "registerPublisher", topic)

    def subscribes(self, process: Process, topic: str) -> None:
        """Make a node subscribe to a topic."""
        process.subscribes.setdefault(topic, Subscription())
        self.call(process, "registerSubscriber", topic)

    def changes_its_mind(self) -> None:
        """Make a node register or unregister something."""
        process, topic = self._living(), self.rng.choice(TOPICS)
        if process is None or any(one[1] == topic for one in process.calling):
            return
        if self.rng.random() < 0.5:
            if topic in process.publishes:
                process.publishes.discard(topic)
                self.call(process, "unregisterPublisher", topic)
            else:
                self.publishes(process, topic)
        elif topic in process.subscribes:
            for key in process.subscribes.pop(topic).ways.values():
                self.disconnect(process, topic, key)
            self.call(process, "unregisterSubscriber", topic)
        else:
            self.subscribes(process, topic)

    def dies(self) -> None:
        """Kill a node, without an unregistration."""
        process = self._living()
        if process is not None:
            self.ends(process)

    def hangs(self) -> None:
        """Make a node hang, or continue."""
        process = self._living()
        if process is not None:
            process.answers = not process.answers
            self.say(
                f"{process.name} at {process.host}:{process.port} {'answers' if process.answers else 'hangs'}"
            )

    def reloads(self) -> None:
        """Put another policy in force."""
        self.policy = self.rng.choice(list(POLICIES))
        self.say(f"policy: {self.policy}")
        self.control.reload(POLICIES[self.policy][0])

    def master_dies(self) -> None:
        """Replace `rosmaster` by a new one without state."""
        self.say("ROSMaster begins anew")
        self.master.restart()
        self.control.reconciler.wake()

    def relay_dies(self) -> None:
        """Replace the relay by a new one without state."""
        self.say("the relay begins anew")
        self.relay = Relay(self)
        self.task(self.carrying(self.relay))
        self.control.attach()

    async def control_dies(self) -> None:
        """Kill control between two steps; its running tasks end with it, and nodes repeat their calls."""
        self.say("control begins anew")
        calls = [(one, what) for one in self.processes if one.alive for what in one.calling]
        await self.stop()
        for process in self.processes:
            process.calling.clear()
            for subscription in process.subscribes.values():
                subscription.known = list(subscription.ways)
        self.relay.orders.clear()
        self.control = Control(self)
        await self.go_on()
        for process, (method, topic) in calls:
            self.call(process, method, topic)

    async def go_on(self) -> None:
        """Start all background tasks."""
        await self.control.begin()
        self.task(self.carrying(self.relay))
        self.task(self.connecting())

    async def stop(self) -> None:
        """Stop all background tasks."""
        mine = asyncio.current_task()
        tasks = sorted(asyncio.all_tasks() - {mine}, key=lambda one: int(one.get_name().rpartition("-")[2]))
        for task in tasks:
            task.cancel()
        await asyncio.gather(*tasks, return_exceptions=True)

    # --- promises ---

    def may(self, process: Process, topic: str, *, publish: bool) -> bool:
        """Whether the policy in force lets a node publish, or subscribe to, a topic."""
        _, publishers, subscribers = POLICIES[self.policy]
        return process.host in (publishers if publish else subscribers).get(topic, HOSTS)

    def see(self, process: Process, uris: list[str]) -> None:
        """Assert that nodes get relay ports only: messages to other ports would bypass the monitors."""
        for uri in uris:
            if not uri.startswith("http://10.0.0.1:2") and uri != process.api:
                self.errors.append(
                    BrokenPromiseError(f"{process.name} was told {uri}, which bypasses the relay")
                )

    def check_granted(self) -> None:
        """Assert that no node has anything that the policy denies, once the relay has carried out its orders."""
        for _key, topic, host, name in self.relay.grants:
            self.check_grant(topic, host, name)
        for key, topic in self.relay.publications:
            publisher = self.control.registry.by_key(key)
            if publisher is None or str(publisher.host) not in POLICIES[self.policy][1].get(topic, HOSTS):
                raise BrokenPromiseError(f"{key} publishes {topic}, which the policy denies")

    def check_grant(self, topic: str, host: str, name: str) -> None:
        """Assert that the policy grants a topic to a subscriber: when the relay gets the grant, and at the end."""
        if host not in POLICIES[self.policy][2].get(topic, HOSTS):
            text = f"{name} of {host} has {topic}, which the policy does not grant"
            self.errors.append(BrokenPromiseError(text))

    def check_master(self) -> None:
        """Assert that `rosmaster` has exactly the registrations of live nodes."""
        faces = self.control.faces
        wanted = {
            (one.kind, one.resource, node.name, faces.inner_uri(node))
            for node, one in self.control.registry.in_order()
        }
        there = {
            (kind, resource, name, uri)
            for kind, table in self.master.tables.items()
            for resource, holders in table.items()
            for name, uri in holders.items()
        }
        if there != wanted:
            raise BrokenPromiseError(f"rosmaster has {there - wanted} and lacks {wanted - there}")

    def check_connected(self) -> None:
        """Assert that live subscribers are connected to exactly the live publishers that the policy allows."""
        holders = {}
        for incarnation in self.control.registry.live():
            for process in self.processes:
                if process.alive and (process.name, process.api) == (incarnation.name, incarnation.api_text):
                    holders[incarnation.key] = process
        for process in self.processes:
            if (
                process in holders.values() and not process.superseded
            ):  # else it is dead, or another node has its name
                for topic, subscription in process.subscribes.items():
                    self._check_heard(process, topic, subscription, holders)

    def _check_heard(
        self, process: Process, topic: str, subscription: Subscription, holders: dict[str, Process]
    ) -> None:
        wanted = {
            key
            for key, one in holders.items()
            if one is not process and topic in one.publishes
            if self.may(one, topic, publish=True) and self.may(process, topic, publish=False)
        }
        whose = topic, process.host, process.name
        heard = {key for key, *rest in self.relay.connections if tuple(rest) == whose}
        told = {subscription.ways.get(uri, uri) for uri in subscription.known}
        open_to_doubt = {key for key, one in holders.items() if one.superseded}
        wanted, heard, told = (keys - open_to_doubt for keys in (wanted, heard, told))
        if heard != wanted or told != wanted:
            who = f"{process.name} at {process.host}:{process.port}"
            raise BrokenPromiseError(f"{who} hears {heard} on {topic}, knows {told}, and may have {wanted}")


class _Ports:
    """`Places` without real ports."""

    def socket(self, port: int) -> "_Ports":
        self._port = port
        return self

    def fileno(self) -> int:
        return self._port


class _Monitors:
    """Monitors without a specification in force."""

    def statement(self, _relay: int) -> messages.SpecificationsStated:
        return messages.SpecificationsStated(0, b"", {}, restarted=False)


@contextlib.contextmanager
def instead_of(place: Any, name: str, other: object) -> Iterator[None]:
    """Replace an existing attribute during the block."""
    before = getattr(place, name)
    setattr(place, name, other)
    try:
        yield
    finally:
        setattr(place, name, before)


async def _history(seed: int, loop: VirtualLoop, say: Callable[[str], object]) -> None:
    world = World(seed, loop, say)
    try:
        await _run(world)
    finally:
        await world.stop()


async def _run(world: World) -> None:
    await world.go_on()
    for _ in range(world.rng.randrange(6, 24)):
        action = world.rng.choice((
            world.starts, world.starts, world.starts, world.changes_its_mind, world.changes_its_mind, world.dies,
            world.hangs, world.reloads, world.reloads, world.master_dies, world.relay_dies, world.control_dies,
        ))  # fmt: skip
        done = action()
        if done is not None:
            await done
        await asyncio.sleep(world.rng.choice((0.0, 0.001, 0.05, 0.5, 3.0, 30.0)))
    world.faulty = False
    for process in world.processes:
        process.answers = True
    world.say("no faults any more")
    await asyncio.sleep(_SETTLES)
    world.check_granted()
    if world.errors:
        raise world.errors[0]
    world.check_connected()
    world.check_master()


def run(seed: int, say: Callable[[str], object] = lambda _line: None) -> None:
    """Run one history. Raises `BrokenPromiseError`."""
    loop = VirtualLoop()
    clock = SimpleNamespace(time=loop.time, monotonic=loop.time)
    keys = count(1)
    with contextlib.ExitStack() as stack:
        stack.callback(loop.close)
        for module in (arrivals_module, graph_module, liveness_module):
            stack.enter_context(instead_of(module, "time", clock))
        stack.enter_context(instead_of(arrivals_module, "new_key", lambda: f"{next(keys):032x}"))
        loop.run_until_complete(_history(seed, loop, say))


def _nothing(*_given: Any, **_named: Any) -> list[Effect]:
    """Do nothing, in place of a removed part."""
    return []


async def _no_round(_reconciler: Reconciler) -> None:
    """Do nothing, in place of a comparison."""


def _without(kind: type[Any]) -> Callable[[Enactor, Any], None]:
    """Return an enactor that leaves out effects of a kind."""
    whole = Enactor.carry_out
    return lambda enactor, effects: whole(enactor, [one for one in effects if not isinstance(one, kind)])


def _granted_nowhere(self: RelayControl, post: Any, incarnation: Incarnation) -> None:
    for one in incarnation.registrations.values():
        if one.kind is Kind.PUBLICATION:
            self._place_one(post, incarnation, one.kind, one.resource, one.detail)


MUTANTS: dict[str, tuple[Any, str, Any]] = {
    "a subscriber is not told of a new publisher": (RosGraph, "tell", _nothing),
    "nodes are told each other's own URIs": (
        Incarnation,
        "uri_for",
        lambda node, _told, hidden: node.real_uri,
    ),
    "a reload takes back no registration": (RosGraph, "revoked", _nothing),
    "a reload takes back no grant": (Revocation, "_revoke", _nothing),
    "what a policy took is not put back": (Revocation, "returned", _nothing),
    "an earlier life keeps its name": (RosGraph, "_take_name", _nothing),
    "a lost node keeps its publications": (Registry, "_unindex", _nothing),
    "a new relay is not told of grants": (RelayControl, "_place", _granted_nowhere),
    "a grant is not kept": (Enactor, "carry_out", _without(SaveGrant)),
    "a registration is not kept": (Enactor, "carry_out", _without(SaveRegistration)),
    "the relay is not told of a grant": (Enactor, "carry_out", _without(PlaceGrant)),
    "the relay is not told what is revoked": (Enactor, "carry_out", _without(RevokeGrant)),
    "the relay is not told who publishes": (Enactor, "carry_out", _without(PlaceResource)),
    "a round leaves the ROS master as it is": (Reconciler, "_compare", _no_round),
    "a node that comes back is placed nowhere": (Enactor, "carry_out", _without(PlaceNode)),
}
"""Faults of the core: the replaced attribute, and its replacement."""


def first_broken(mutant: str, limit: int) -> int | None:
    """Return the first seed whose history breaks a promise with a faulty core."""
    place, name, instead = MUTANTS[mutant]
    with instead_of(place, name, instead):
        for seed in range(limit):
            try:
                run(seed)
            except (AssertionError, KeyError):
                return seed
    return None


def main(arguments: list[str]) -> None:
    """Run the command line that the head of this file describes."""
    if os.environ.get("PYTHONHASHSEED") != "0":  # sets of strings have another order in each process
        os.environ["PYTHONHASHSEED"] = "0"
        os.execv(sys.executable, [sys.executable, "-m", "tests.support.histories", *arguments])  # noqa: S606  this program again
    structlog.configure(wrapper_class=structlog.make_filtering_bound_logger(logging.CRITICAL))
    write = sys.stdout.write
    match arguments:
        case ["--many", number]:
            for seed in range(int(number)):
                try:
                    run(seed)
                except BrokenPromiseError as error:
                    write(f"seed {seed}: {error}\n")
        case ["--mutants", number]:
            for mutant in MUTANTS:
                write(f"{mutant}: {first_broken(mutant, int(number))}\n")
        case [seed]:
            run(int(seed), lambda line: write(f"{line}\n"))


if __name__ == "__main__":
    main(sys.argv[1:])
