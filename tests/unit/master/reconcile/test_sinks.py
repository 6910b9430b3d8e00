"""After any history, each sink has exactly the state of the registry, as if it had started just now."""

import asyncio
import tempfile
from collections.abc import Sequence
from pathlib import Path
from typing import Any, cast

import msgspec
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from appliance.channel import messages
from appliance.master.endpoints.delivery import NodeCall
from appliance.master.graph.registry import Incarnation, Kind, Life, Registry
from appliance.master.reconcile.sinks import restore
from appliance.store.changes import Change as StoredChange
from appliance.store.changes import Encoded, WriteAhead
from appliance.store.state_file import PermissionRow, StateStore
from roswire.xmlrpc import Value
from tests.support import autojump
from tests.support.control_parts import HOST, OPEN, POLICY, ControlParts, Told
from tests.support.engines import InlineDatabase
from tests.support.examples import examples

WITHDRAWALS = (
    messages.PublicationWithdrawn | messages.ServiceWithdrawn | messages.GrantRevoked | messages.ClientRevoked
)
NODES, TOPICS = range(4), ("/t", "/t", "/secret")
POLICIES = {
    "open": OPEN,
    "closed": POLICY.format("/secret=\n", "/secret=\n"),
    "limited": f"{OPEN}[Limits]\n/t = publisher 30 Hz, subscriber 5 Hz\n",
}
CALLS = st.tuples(
    st.sampled_from(["register", "register", "register", "unregister"]),
    st.sampled_from(NODES),
    st.sampled_from(list(Kind)),
    st.sampled_from(TOPICS),
)
STEPS = st.one_of(
    CALLS,
    CALLS,
    CALLS,
    st.tuples(
        st.just("grant"),
        st.sampled_from(NODES),
        st.sampled_from([Kind.PUBLICATION, Kind.SERVICE]),
        st.sampled_from(TOPICS),
    ),
    st.tuples(st.sampled_from(["lose", "return", "forget"]), st.sampled_from(NODES)),
    st.tuples(st.just("policy"), st.sampled_from(sorted(POLICIES))),
    st.sampled_from([("flush",), ("pause",), ("a relay starts",), ("the ROS master starts",)]),
)


class History(ControlParts):
    """Control with a real store, in which nodes come and go. `/a` has two lives."""

    def __init__(self, folder: Path) -> None:
        self._folder = folder
        super().__init__()

    def surround(self) -> None:
        self.store = StateStore(self._folder, failed=pytest.fail, kind=InlineDatabase)

    async def step(self, what: str, *about: Any) -> None:
        match what, *about:
            case ("flush",):
                self.sinks.flush()
            case ("pause",):
                await asyncio.sleep(0.3)
            case ("a relay starts",):
                self.start_relay()
            case ("the ROS master starts",):
                self.hidden.restart()
                await self.round()
            case "policy", name:
                self.reload(POLICIES[name])
            case _, number, *rest:
                self._of_node(what, number, *rest)

    def _of_node(self, what: str, number: int, kind: Kind = Kind.PUBLICATION, topic: str = "") -> None:
        name, uri = ("/a", "/a", "/b", "/c")[number], f"http://{HOST}:{4000 + number}/"
        node = self.registry.find(name, HOST, uri)
        if node is None or node.life is Life.REPLACED:
            if what != "register" or node is not None:
                return
            node = self.node(name, number)
        match what:
            case "register" if self.revocation.may_have(node, kind, topic):
                self.graph.registered(node, kind, topic, "4001")
                if kind is Kind.SUBSCRIPTION:
                    answer: list[Value] = [*self.subscribers.list_for(node, topic)]
                    self.seen.append(Told(node, NodeCall("publisherUpdate", (topic, answer))))
            case "unregister":
                self.graph.unregistered(node, kind, topic)
            case "grant" if (kind, topic) in node.registrations:
                grant = self.graph.topic_granted if kind is Kind.PUBLICATION else self.graph.service_granted
                grant(node, topic, HOST, "/b")
            case "lose" if node.life is Life.LIVE:
                self.graph.lost(node, "away")
            case "return" if node.life is Life.SHADOW and self.registry.occupant(node.name) is None:
                self.graph.returned(node)
                self.revocation.returned(node)
            case "forget":
                self.graph.forgotten(node)

    def at_relay(self) -> dict[Any, messages.Message]:
        """Return the facts of the present relay. A node takes its facts with it."""
        facts: dict[Any, messages.Message] = {}
        for message in self.seen:
            if isinstance(message, messages.StateBegan):
                facts.clear()
            elif isinstance(message, messages.RelayFact):
                facts[messages.identity(message)] = message
            elif isinstance(message, messages.NodeWithdrawn):
                facts = {fact: one for fact, one in facts.items() if fact[1] != message.key}
            elif isinstance(message, WITHDRAWALS):
                del facts[messages.identity(message)]
        return facts

    def lists(self) -> dict[tuple[str, str], list[str]]:
        """Return the last list that each live node got for each of its topics, in an answer or an update."""
        lists: dict[tuple[str, str], list[str]] = {}
        for seen in self.seen:
            if isinstance(seen, Told) and seen.call.method == "publisherUpdate":
                topic, uris = seen.call.parameters
                lists[seen.node.key, str(topic)] = cast(list[str], uris)
        return {
            (node.key, topic): lists[node.key, topic]
            for node in self.registry.live()
            for kind, topic in node.registrations
            if kind is Kind.SUBSCRIPTION
        }


def content(registry: Registry) -> dict[str, Any]:
    def rows(node: Incarnation) -> tuple[Any, ...]:
        return node.name, node.life, list(node.registrations.values()), list(node.shelf.values())

    return {node.key: rows(node) for node in registry.all()}


async def lived(steps: list[tuple[Any, ...]], folder: Path) -> None:
    world = History(folder)
    await world.round()
    for step in steps:
        await world.step(*step)
    await world.settle()
    wanted = {
        (registration.kind, registration.resource): world.registry.registered(
            registration.kind, registration.resource
        )
        for _node, registration in world.registry.in_order()
        if registration.kind is not Kind.PARAMETER
    }
    there = {
        (kind, resource): set(names)
        for kind, table in world.hidden.tables.items()
        for resource, names in table.items()
        if names
    }
    assert there == {key: {node.name for node in nodes} for key, nodes in wanted.items()}
    assert world.lists() == {
        (node.key, topic): list(world.registry.uris_for(node, Kind.PUBLICATION, topic, hidden=True))
        for node in world.registry.live()
        for kind, topic in node.registrations
        if kind is Kind.SUBSCRIPTION
    }
    stored = Registry()
    restore(stored, world.store)
    ours, kept = content(world.registry), content(stored)
    assert {
        key: (one[0], one[1], sorted(one[2], key=str), sorted(one[3], key=str)) for key, one in kept.items()
    } == {
        key: (one[0], one[1], sorted(one[2], key=str), sorted(one[3], key=str)) for key, one in ours.items()
    }
    assert set(world.store.permissions()) == set(world.grants.all())
    at_relay = world.at_relay()
    world.seen.clear()
    world.start_relay()
    at_new_relay = world.at_relay()
    # A relay keeps the port of a node that has no topics at present.
    idle = {("node", node.key) for node in world.registry.all() if node.life is Life.LIVE}
    assert {
        fact: at_relay[fact] for fact in at_relay if fact not in idle or fact in at_new_relay
    } == at_new_relay
    world.store.close()


@settings(max_examples=examples(300))
@given(st.lists(STEPS, max_size=40))
def test_every_sink_has_what_the_registry_has(steps: list[tuple[Any, ...]]) -> None:
    with tempfile.TemporaryDirectory(dir="/dev/shm" if Path("/dev/shm").is_dir() else None) as folder:
        autojump.run(lived(steps, Path(folder)))


@pytest.mark.anyio
async def test_a_change_without_a_flush_is_stated_in_the_same_turn() -> None:
    world = await ControlParts.begun()
    world.graph.registered(world.node("/n"), Kind.PUBLICATION, "/t", "t")
    assert messages.PublicationPlaced not in {type(seen) for seen in world.seen}
    await asyncio.sleep(0)
    assert messages.PublicationPlaced in {type(seen) for seen in world.seen}


@pytest.mark.anyio
async def test_the_changes_of_a_turn_are_stored_together(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A crash loses all of them or none. A turn with thousands of changes is written in parts, in order."""
    world = History(tmp_path)
    await world.round()
    written = list[int]()
    append = WriteAhead.append

    def noted(ahead: WriteAhead, changes: Sequence[Encoded]) -> None:
        written.append(sum(len(getattr(decoded(one.body), "rows", [one])) for one in changes))
        append(ahead, changes)

    decoded = msgspec.msgpack.Decoder(StoredChange).decode
    monkeypatch.setattr(WriteAhead, "append", noted)
    for name in ("/a", "/b"):
        node = world.node(name)
        world.graph.registered(node, Kind.PUBLICATION, "/t", "t")
        world.graph.topic_granted(node, "/t", HOST, "/c")
    world.sinks.flush()
    assert len(written) == 1
    written.clear()
    for number in range(2500):
        world.graph.topic_granted(node, "/t", HOST, f"/c{number}")
    world.sinks.flush()
    assert written == [1000, 1000, 500]
    assert set(world.store.permissions()) == set(world.grants.all())
    world.store.close()


@pytest.mark.anyio
async def test_a_relay_that_takes_no_messages_delays_no_other_sink() -> None:
    world = await ControlParts.begun()
    old, new = world.node("/n", 1), world.node("/n", 2)
    await world.register(old, Kind.PUBLICATION, "/t")

    world.full = True
    world.graph.registered(new, Kind.PUBLICATION, "/t", "t")
    await world.settle()
    assert [name for name, method, _ in world.deliveries.told if method == "shutdown"] == ["/n"]
    assert world.hidden.nodes["/n"] == world.faces.inner_uri(new)
    assert ("close", old) in world.seen


@pytest.mark.anyio
async def test_a_relay_gets_what_it_could_not_take_as_soon_as_it_reads() -> None:
    """Neither a grant, a revocation nor the end of a node waits for a later change or for a new relay."""
    world = await ControlParts.begun()
    ended, node = world.node("/ended", 1), world.node("/n", 2)
    for one in (ended, node):
        await world.register(one, Kind.PUBLICATION, "/t")
    world.graph.topic_granted(node, "/t", HOST, "/old")
    await world.settle()

    world.full = True
    world.graph.forgotten(ended)
    world.grants.take(PermissionRow(node.key, "topic", "/t", str(HOST), "/old"))
    world.graph.topic_granted(node, "/t", HOST, "/new")
    world.sinks.flush()
    order = asyncio.ensure_future(world.relay.carried_out())
    await asyncio.sleep(3)
    assert not order.done()
    assert not {type(seen) for seen in world.seen} & {messages.NodeWithdrawn, messages.GrantRevoked}
    world.seen.clear()
    world.full = False
    await asyncio.sleep(0.2)
    assert [
        seen for seen in world.seen if isinstance(seen, messages.NodeWithdrawn | messages.GrantRevoked)
    ] == [
        messages.NodeWithdrawn(ended.key),
        messages.GrantRevoked(node.key, "/t", str(HOST), "/old"),
    ]
    assert [
        (seen.key, seen.caller_id) for seen in world.seen if isinstance(seen, messages.GrantInstalled)
    ] == [(node.key, "/new")]
    assert world.seen[-1] == messages.OrdersAsked()
    order.cancel()


@pytest.mark.anyio
async def test_an_order_reaches_a_relay_that_does_not_read() -> None:
    """Its answer comes when the relay reads again, or has ended."""
    world = await ControlParts.begun()
    world.full = True
    order = asyncio.ensure_future(world.relay.carried_out())
    stop = asyncio.ensure_future(world.relay.stop("/t"))
    await asyncio.sleep(1)
    assert {messages.OrdersAsked, messages.StopWanted} <= {type(seen) for seen in world.seen}
    world.relay._posts[0].close()
    await asyncio.wait_for(order, 1)
    stop.cancel()


@pytest.mark.anyio
async def test_a_node_without_a_descriptor_delays_no_other_node(monkeypatch: pytest.MonkeyPatch) -> None:
    world = await ControlParts.begun()
    first, second = world.node("/first", 1), world.node("/second", 2)
    first.relay_port = 7
    ports = world.relay.places.socket

    def socket(port: int) -> Any:
        if port == first.relay_port:
            raise OSError(24, "Too many open files")
        return ports(port)

    def placed() -> list[str]:
        return [seen.key for seen in world.seen if isinstance(seen, messages.PublicationPlaced)]

    with monkeypatch.context() as patched:
        patched.setattr(world.relay.places, "socket", socket)
        for node in (first, second):
            world.graph.registered(node, Kind.PUBLICATION, "/t", "t")
        world.sinks.flush()
        assert placed() == [second.key]
        world.seen.clear()
        world.start_relay()
        assert placed() == [second.key]
        assert messages.StateEnded in {type(seen) for seen in world.seen}
    await asyncio.sleep(0.2)
    assert placed() == [second.key, first.key]


@pytest.mark.anyio
async def test_a_defect_of_a_sink_takes_no_change_from_the_others(monkeypatch: pytest.MonkeyPatch) -> None:
    world = await ControlParts.begun()
    node = world.node("/n")
    await world.register(node, Kind.PUBLICATION, "/t")

    def fail(_sink: object, _changed: object) -> None:
        raise ArithmeticError

    with monkeypatch.context() as patched:
        for sink in (type(world.subscribers), type(world.entries)):
            patched.setattr(sink, "flush", fail)
        world.graph.forgotten(node)
        with pytest.raises(ArithmeticError):
            world.sinks.flush()
    assert messages.NodeWithdrawn(node.key) in world.seen
    assert ("close", node) in world.seen
