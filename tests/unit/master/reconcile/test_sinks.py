"""After any history, each sink has exactly the state of the registry, as if it had just started."""

import asyncio
from collections.abc import Sequence
from pathlib import Path

import msgspec
import pytest

from appliance.channel import messages
from appliance.master.graph.registry import Kind
from appliance.store.changes import Change as StoredChange
from appliance.store.changes import Encoded, WriteAhead
from appliance.store.state_file import PermissionRow
from tests.support.control_parts import HOST, ControlParts
from tests.support.examples import examples
from tests.unit.master.reconcile.sink_history import History, history, live, shortest


def test_every_sink_has_what_the_registry_has() -> None:
    for seed in range(examples(300)):
        try:
            live(history(seed))
        except AssertionError as error:
            error.add_note(f"seed {seed}; these steps are enough: {shortest(history(seed))}")
            raise


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
    world = History(tmp_path)
    await world.round()
    written = list[int]()
    append = WriteAhead.append

    def noted(ahead: WriteAhead, changes: Sequence[Encoded]) -> None:
        written.append(sum(len(getattr(decoded(change.body), "rows", [change])) for change in changes))
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
    """No grant, revocation or end of a node waits for a later change or for a new relay."""
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
    assert messages.FactWithdrawn not in map(type, world.seen)
    world.seen.clear()
    world.full = False
    await asyncio.sleep(0.2)
    assert [seen for seen in world.seen if isinstance(seen, messages.FactWithdrawn)] == [
        messages.FactWithdrawn(("node", ended.key)),
        messages.FactWithdrawn(("grant", node.key, "/t", str(HOST), "/old")),
    ]
    assert [
        (seen.key, seen.caller_id) for seen in world.seen if isinstance(seen, messages.GrantInstalled)
    ] == [(node.key, "/new")]
    assert world.seen[-1] == messages.OrdersAsked()
    order.cancel()


@pytest.mark.anyio
async def test_an_order_reaches_a_relay_that_does_not_read() -> None:
    world = await ControlParts.begun()
    world.full = True
    order = asyncio.ensure_future(world.relay.carried_out())
    stop = asyncio.ensure_future(world.relay.taps.stop("/t"))
    await asyncio.sleep(1)
    assert {messages.OrdersAsked, messages.StopWanted} <= {type(seen) for seen in world.seen}
    world.start_relay()
    await asyncio.wait_for(order, 1)
    stop.cancel()


@pytest.mark.anyio
async def test_a_node_without_a_descriptor_delays_no_other_node(monkeypatch: pytest.MonkeyPatch) -> None:
    world = await ControlParts.begun()
    first, second = world.node("/first", 1), world.node("/second", 2)
    first.relay_port = 7

    def exhausted(port: int) -> int:
        if port == first.relay_port:
            raise OSError(24, "Too many open files")
        return port

    def placed() -> list[str]:
        return [seen.key for seen in world.seen if isinstance(seen, messages.PublicationPlaced)]

    with monkeypatch.context() as patched:
        patched.setattr(world.relay, "descriptor", exhausted)
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
    assert messages.FactWithdrawn(("node", node.key)) in world.seen
    assert ("close", node) in world.seen
