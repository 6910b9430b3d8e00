"""A history of control's parts, after which each sink must have exactly the state of the registry."""

import asyncio
import tempfile
from collections.abc import Callable
from pathlib import Path
from random import Random
from typing import Any

import pytest

from appliance.channel import messages
from appliance.master.endpoints.delivery import NodeCall
from appliance.master.graph.registry import Incarnation, Kind, Life, Registry
from appliance.master.reconcile.sinks import restore
from appliance.master.rosmaster import Answer, stand_in
from appliance.store.state_file import StateStore
from roswire.parameter_tree import standing_at
from roswire.xmlrpc import Value
from tests.support import autojump
from tests.support.control_parts import (
    HOST,
    OPEN,
    POLICY,
    ControlParts,
    Deliveries,
    Ended,
    HiddenMaster,
    Seen,
    Told,
)
from tests.support.engines import InlineDatabase
from tests.support.parameters import put

NAMES = "/a", "/a", "/b", "/c"
TOPICS = "/t", "/t", "/secret"
ADDRESSES = "10.0.0.1", "10.0.0.2"
ALONE = "flush", "pause", "check", "check", "a relay starts", "the ROS master starts"
POLICIES = {
    "open": OPEN,
    "closed": POLICY.format("/secret=\n", "/secret=\n")
    + "[Parameters]\nread /secret=\nread default=*\nwrite default=*\n",
    "limited": f"{OPEN}[Limits]\n/t = publisher 30 Hz, subscriber 5 Hz\n",
}
Step = tuple[Any, ...]


def history(seed: int) -> list[Step]:
    random = Random(seed)  # noqa: S311  histories, no secrets

    def step() -> Step:
        number, topic = random.randrange(len(NAMES)), random.choice(TOPICS)
        kind, provided = random.choice(list(Kind)), random.choice([Kind.PUBLICATION, Kind.SERVICE])
        steps: list[Step] = [
            *[("register", number, kind, topic)] * 3,
            ("unregister", number, kind, topic),
            ("grant", number, provided, topic),
            (random.choice(["lose", "return", "return", "forget", "blink"]), number),
            random.choice([("move", number, random.choice(ADDRESSES)), ("set", topic, random.randrange(9))]),
            ("policy", random.choice(sorted(POLICIES))),
            *[(random.choice(ALONE),)] * 2,
        ]
        return random.choice(steps)

    return [step() for _ in range(80)]


class SlowNodes(Deliveries):
    def __init__(self, note: Callable[[Seen], None]) -> None:
        super().__init__(note)
        self.held: list[Told] = []

    def push(self, incarnation: Incarnation, call: NodeCall) -> None:
        self.held.append(Told(incarnation, call))

    def answered(self, incarnation: Incarnation, topic: str, publishers: tuple[str, ...]) -> None:
        self.drop_list(incarnation, topic)
        super().answered(incarnation, topic, publishers)

    def drop_list(self, incarnation: Incarnation, topic: str) -> None:
        super().drop_list(incarnation, topic)
        self.held = [
            one
            for one in self.held
            if (one.node, one.call.method, one.call.parameters[0]) != (incarnation, "publisherUpdate", topic)
        ]

    def drop(self, incarnation: Incarnation) -> None:
        self.forget_lists(incarnation)
        self.held = [one for one in self.held if one.node is not incarnation]

    def arrive(self) -> None:
        for one in self.held:
            assert one.node.life is Life.LIVE or one.call.method == "shutdown", f"to a node that ended: {one}"
            if one.call.method == "publisherUpdate":
                subscription = Kind.SUBSCRIPTION, str(one.call.parameters[0])
                assert subscription in {*one.node.registrations, *one.node.shelf}, (
                    f"not subscribed any more: {one}"
                )
            super().push(*one)
        self.held.clear()


class StrictMaster(HiddenMaster):
    def __init__(self, note: Callable[[Seen], None]) -> None:
        super().__init__(note)
        self.repeated: list[tuple[Value, ...]] = []

    def carry_out(self, method: str, *params: Value) -> Answer:
        before = {
            kind: {name: dict(nodes) for name, nodes in table.items()} for kind, table in self.tables.items()
        }
        answer = super().carry_out(method, *params)
        if method.startswith("register") and self.tables == before:
            self.repeated.append((method, *params))
        return answer


class History(ControlParts):
    """Control with a real store, in which nodes come and go. `/a` has two lives."""

    def __init__(self, folder: Path) -> None:
        self.store = StateStore(folder, failed=pytest.fail, kind=InlineDatabase)
        self.made: list[Incarnation] = []
        super().__init__(store=self.store)

    def surround(self) -> None:
        self.delivery = self.deliveries = self.slow = SlowNodes(self.seen.append)
        self.hidden = self.strict = StrictMaster(self.seen.append)

    async def step(self, what: str, *about: Any) -> None:
        match what, *about:
            case ("flush",):
                self.sinks.flush()
            case ("pause",):
                await asyncio.sleep(0.3)
                self.slow.arrive()
            case ("check",):
                await self.check()
            case ("a relay starts",):
                self.start_relay()
            case ("the ROS master starts",):
                self.hidden.restart()
                await self.round()
                await self._check_reminded()
            case "policy", name:
                self.reload(POLICIES[name])
            case "set", key, value:  # the ROS master has accepted it in an earlier turn
                self.sinks.flush()
                put(self.parameters, key, value, HOST)
                self.subscribers.parameter_set(key, value, None, None)
            case "move", number, address:
                if (node := self._known(number)) is not None:
                    self.registry.reached_at(node, address)
            case _, number, *rest:
                self._of_node(what, number, *rest)

    def _known(self, number: int) -> Incarnation | None:
        return self.registry.find(NAMES[number], HOST, f"http://{HOST}:{4000 + number}/")

    def _of_node(self, what: str, number: int, kind: Kind = Kind.PUBLICATION, topic: str = "") -> None:
        node = self._known(number)
        if node is None or node.life is Life.REPLACED:
            if what != "register" or node is not None:
                return
            node = self.node(NAMES[number], number)
            self.made.append(node)
        match what:
            case "register" if self.revocation.may_have(node, kind, topic):
                self._register(node, kind, topic)
            case "unregister":
                self.graph.unregistered(node, kind, topic)
            case "grant" if (kind, topic) in node.registrations:
                grant = self.graph.topic_granted if kind is Kind.PUBLICATION else self.graph.service_granted
                grant(node, topic, HOST, "/b")
            case "lose" if node.life is Life.LIVE:
                self.graph.lost(node, "away")
            case "blink" if node.life is Life.LIVE:
                self.graph.lost(node, "away")
                self.sinks.flush()
                self._of_node("return", number)
            case "return" if node.life is Life.SHADOW and self.registry.occupant(node.name) is None:
                self.graph.returned(node)
                self.revocation.returned(node)
            case "forget":
                self.graph.forgotten(node)

    def _register(self, node: Incarnation, kind: Kind, topic: str) -> None:
        """Register a node. Values arrive before its answer, which replaces a list that waits."""
        if kind not in {Kind.SUBSCRIPTION, Kind.PARAMETER}:
            self.graph.registered(node, kind, topic, "4001")
            return
        self.sinks.flush()
        if kind is Kind.PARAMETER:
            self.slow.arrive()
        self.graph.registered(node, kind, topic, "4001")
        if kind is Kind.SUBSCRIPTION:
            answer: list[Value] = [*self.subscribers.list_for(node, topic)]
            self.seen.append(Told(node, NodeCall("publisherUpdate", (topic, answer))))
        else:
            self.subscribers.value_given(node, topic)
            self.seen.append(Told(node, NodeCall("paramUpdate", (f"{topic}/", self.value(topic)))))
        self.sinks.flush()
        name = topic if kind is Kind.SUBSCRIPTION else f"{topic}/"
        assert not [one for one in self.slow.held if one.node is node and one.call.parameters[0] == name]

    def value(self, key: str) -> Value:
        present, _ = standing_at(self.parameters.tree, key)
        return {} if present is None else present

    async def _check_reminded(self) -> None:
        self.slow.arrive()
        before = len(self.seen)
        self.hidden.restart()
        await self.round()
        self.slow.arrive()
        told = [one for one in self.seen[before:] if isinstance(one, Told)]
        assert sorted((one.node.key, str(one.call.parameters[0])) for one in told) == sorted(
            (node.key, topic)
            for node in self.registry.live()
            for kind, topic in (*node.registrations, *node.shelf)
            if kind is Kind.SUBSCRIPTION
        )

    async def check(self) -> None:
        await self.settle()
        self.slow.arrive()
        check_rosmaster(self)
        check_nodes(self)
        check_store(self)
        await check_quiet(self)

    def at_relay(self) -> dict[Any, messages.Message]:
        facts: dict[Any, messages.Message] = {}
        for message in self.seen:
            if isinstance(message, messages.StateBegan):
                facts.clear()
            elif isinstance(message, messages.RelayFact):
                assert facts.get(messages.identity(message)) != message, f"stated twice: {message}"
                facts[messages.identity(message)] = message
                assert ("node", message.key) in facts, f"without its node: {message}"
            elif isinstance(message, messages.FactWithdrawn) and message.fact[0] == "node":
                facts = {fact: one for fact, one in facts.items() if fact[1] != message.fact[1]}
            elif isinstance(message, messages.FactWithdrawn):
                del facts[message.fact]
        return facts

    def told(self) -> dict[tuple[str, str], dict[str, Value]]:
        told: dict[tuple[str, str], dict[str, Value]] = {}
        for seen in self.seen:
            if isinstance(seen, Told):
                resource, *value = seen.call.parameters
                told.setdefault((seen.node.key, seen.call.method), {})[str(resource)] = [*value]
        return told


def content(registry: Registry) -> dict[str, Any]:
    def rows(node: Incarnation) -> tuple[Any, ...]:
        places = node.registrations, node.shelf
        return node.name, node.life, node.told, *(sorted(map(str, place.values())) for place in places)

    return {node.key: rows(node) for node in registry.all()}


async def lived(steps: list[Step], folder: Path) -> None:
    world = History(folder)
    await world.round()
    for step in [*steps, ("check",)]:
        await world.step(*step)
    check_relay(world)
    world.store.close()


def check_rosmaster(world: History) -> None:
    assert not world.strict.repeated
    assert not any(method in {"subscribeParam", "unsubscribeParam"} for method, *_ in world.hidden.calls)
    wanted = {
        (one.kind, one.resource, node.name): stand_in(node)
        if one.kind is Kind.SERVICE
        else world.faces.inner_uri(node)
        for node, one in world.registry.in_order()
        if one.kind is not Kind.PARAMETER
    }
    assert {
        (kind, resource, name): uri
        for kind, table in world.hidden.tables.items()
        for resource, names in table.items()
        for name, uri in names.items()
    } == wanted
    assert {(name, world.hidden.nodes[name]) for _kind, _resource, name in wanted} == {
        (node.name, world.faces.inner_uri(node))
        for node, _one in world.registry.in_order()
        if _one.kind is not Kind.PARAMETER
    }


def check_nodes(world: History) -> None:
    told = world.told()
    closed = [seen.node for seen in world.seen if isinstance(seen, Ended) and seen.what == "close"]
    assert {node.key for node in closed} == {
        node.key for node in world.made if node.life in {Life.REPLACED, Life.FORGOTTEN}
    }
    for node in world.made:
        if node.life is Life.REPLACED:
            assert (node.key, "shutdown") in told
    for node in world.registry.live():
        lists, values = told.get((node.key, "publisherUpdate"), {}), told.get((node.key, "paramUpdate"), {})
        for kind, resource in (*node.registrations, *node.shelf):
            shelved = (kind, resource) not in node.registrations
            if kind is Kind.SUBSCRIPTION:
                uris = world.registry.uris_for(node, Kind.PUBLICATION, resource, hidden=True)
                assert lists[resource] == [[] if shelved else [*uris]]
            elif kind is Kind.PARAMETER and not shelved:
                assert values[f"{resource}/"] == [world.value(resource)]


async def check_quiet(world: History) -> None:
    for node in world.registry.live():
        world.registry.mark(node)
    before = len(world.seen)
    await world.settle()
    world.slow.arrive()
    assert world.seen[before:] == []


def check_store(world: History) -> None:
    stored = Registry()
    restore(stored, world.store)
    assert content(stored) == content(world.registry)
    assert set(world.store.permissions()) == set(world.grants.all())


def check_relay(world: History) -> None:
    at_relay = world.at_relay()
    stated = {
        *((one.key, one.topic) for one in at_relay.values() if isinstance(one, messages.PublicationPlaced)),
        *((one.key, one.service) for one in at_relay.values() if isinstance(one, messages.ServicePlaced)),
        *(
            (one.key, one.topic, one.host, one.caller_id)
            for one in at_relay.values()
            if isinstance(one, messages.GrantInstalled)
        ),
        *(
            (one.key, one.service, one.host, one.caller_id)
            for one in at_relay.values()
            if isinstance(one, messages.ClientGranted)
        ),
    }
    live = {node.key for node in world.registry.live()}
    assert stated == {
        *(
            (node.key, one.resource)
            for node, one in world.registry.in_order()
            if one.kind in {Kind.PUBLICATION, Kind.SERVICE}
        ),
        *((row.key, row.resource, row.host, row.caller_id) for row in world.grants.all() if row.key in live),
    }
    world.seen.clear()
    world.start_relay()
    at_new_relay = world.at_relay()
    # A relay keeps the port of a node that has no topics at present.
    idle = {("node", node.key) for node in world.registry.all() if node.life is Life.LIVE}
    assert {
        fact: at_relay[fact] for fact in at_relay if fact not in idle or fact in at_new_relay
    } == at_new_relay


def live(steps: list[Step]) -> None:
    with tempfile.TemporaryDirectory(dir="/dev/shm" if Path("/dev/shm").is_dir() else None) as folder:
        autojump.run(lived(steps, Path(folder)))


def shortest(steps: list[Step]) -> list[Step]:
    size = len(steps) // 2
    while size:
        for begin in range(len(steps) - size, -1, -size):
            fewer = steps[:begin] + steps[begin + size :]
            try:
                live(fewer)
            except AssertionError:
                steps = fewer
        size //= 2
    return steps
