import asyncio
from collections.abc import Awaitable, Callable, Sequence
from typing import Any

import pytest

from appliance.base.withdrawal import WithdrawnError, withdrawable
from appliance.channel import messages
from appliance.specifications.allocation import TOPIC, Allocation, Move, Resource
from appliance.specifications.checking import check
from appliance.specifications.in_force import InForce
from appliance.specifications.rollout import InheritedState, Rollout
from appliance.specifications.specification_files import (
    Sources,
    SpecificationsRefusedError,
)
from tests.support import autojump
from tests.support.core import FakeTrail
from tests.support.stated import parts_here

pytestmark = pytest.mark.anyio


def spec(name: str, *topics: str) -> str:
    events = "".join(
        f"event e{number}() {topic} std_msgs/String '{{}}' {{ }}" for number, topic in enumerate(topics)
    )
    return f"hold {name}() {{ {events} }}"


def revision(number: int, **files: str) -> InForce:
    sources = Sources({f"{name}.rv": text for name, text in files.items()})
    return InForce(number, sources, check(sources, ()))


def taken(statement: messages.SpecificationsStated) -> messages.SpecificationsTaken:
    return messages.SpecificationsTaken(statement.revision, [], [], statement.statement)


def files_of(message: messages.SpecificationsStated) -> list[str]:
    return list(dict.fromkeys(f"{name[0]}.rv" for name in message.enabled))


class Fleet:
    """Two relays. `answer` is the answer of a relay to its statement."""

    def __init__(self) -> None:
        self.trail = FakeTrail()
        self.rollout = Rollout(Allocation(2), self.trail, "drop", self, slices=1000, parts=parts_here)
        self.files = {"a": spec("a", "/a") + spec("a2", "/a"), "b": spec("b", "/b")}
        self.story: list[tuple[Any, ...]] = []
        self.stated: list[tuple[int, messages.SpecificationsStated]] = []
        self.carried: set[Resource] = set()
        self.away: set[int] = set()
        self.wanted: list[int] = []
        self.answer: Callable[[int, messages.SpecificationsStated], messages.Message | None] = (
            lambda _relay, statement: taken(statement)
        )

    def send(self, message: messages.Message, relay: int) -> bool:
        if relay in self.away:
            return False
        if isinstance(message, messages.StateWanted):
            self.wanted.append(message.number)
            return True
        assert isinstance(message, messages.SpecificationsStated)
        self.stated.append((relay, message))
        self.story.append(("stated", relay, message.revision, files_of(message), message.moved))
        answer = self.answer(relay, message)
        if answer is not None:
            asyncio.get_running_loop().call_soon(self.rollout.received, answer, relay)
        return True

    async def carried_out(self) -> None: ...

    def live_resources(self) -> set[Resource]:
        return self.carried

    def withdraw(self, moves: Sequence[Move]) -> None:
        self.story += [
            ("withdrawn", move.name, self.rollout.allocation.of(move.kind, move.name)) for move in moves
        ]

    def place(self, moves: Sequence[Move]) -> None:
        self.story += [
            ("placed", move.name, self.rollout.allocation.of(move.kind, move.name)) for move in moves
        ]


@pytest.fixture
def fleet() -> Fleet:
    fleet = Fleet()
    autojump.run(fleet.rollout.start(revision(1, **fleet.files), restarted=False, kept=""))
    fleet.carried = {(TOPIC, "/a"), (TOPIC, "/b")}
    return fleet


async def test_a_relay_with_unchanged_specifications_gets_the_same_statement(fleet: Fleet) -> None:
    other = fleet.rollout.relay_of("b")
    before = {relay: fleet.rollout.statement(relay).part for relay in range(2)}
    await fleet.rollout.take(revision(2, **fleet.files, c=spec("c", "/a")))
    after = {relay: fleet.rollout.statement(relay).part for relay in range(2)}
    assert after[other] == before[other]
    assert after[1 - other] != before[1 - other]


async def test_each_relay_receives_its_own_specifications(fleet: Fleet) -> None:
    assert fleet.rollout.statement(0).ahead
    assert files_of(fleet.rollout.statement(0)) == ["a.rv"]
    assert files_of(fleet.rollout.statement(1)) == ["b.rv"]
    assert await fleet.rollout.take(revision(2, **fleet.files, c=spec("c", "/b"))) == []
    assert not any(one.ahead for _, one in fleet.stated)
    assert fleet.story[:2] == [("stated", 0, 2, ["a.rv"], ()), ("stated", 1, 2, ["b.rv", "c.rv"], ())]


async def test_a_refusal_of_one_relay_stops_all(fleet: Fleet) -> None:
    def answer(relay: int, statement: messages.SpecificationsStated) -> messages.Message:
        if relay == 1 and statement.revision == 2:
            return messages.SpecificationsRefused(2, ["c.rv:1:1: error: no"], statement.statement)
        return taken(statement)

    fleet.answer = answer
    with pytest.raises(SpecificationsRefusedError, match="no"):
        await fleet.rollout.take(revision(2, **fleet.files, c=spec("c", "/b")))
    assert [one[:3] for one in fleet.story] == [
        ("stated", 0, 2), ("stated", 1, 2), ("stated", 0, 1), ("stated", 1, 1)
    ]  # fmt: skip
    assert fleet.rollout.relay_of("b") == 1


@pytest.mark.nightly
async def test_a_relay_that_dies_counts_as_a_refusal(fleet: Fleet) -> None:
    fleet.answer = lambda relay, statement: None if relay == 1 else taken(statement)
    taking = asyncio.ensure_future(fleet.rollout.take(revision(2, **fleet.files, c=spec("c", "/b"))))
    while len(fleet.story) < 2:
        await asyncio.sleep(0)
    fleet.rollout.lost(1)
    with pytest.raises(SpecificationsRefusedError, match="try again"):
        await taking
    fleet.away = {1}
    await fleet.rollout.take(revision(2, **fleet.files, c=spec("c", "/b")))
    assert files_of(fleet.rollout.statement(1)) == ["b.rv", "c.rv"]


async def test_a_topic_moves_only_between_monitors(fleet: Fleet) -> None:
    moved = await fleet.rollout.take(revision(2, **fleet.files, c=spec("c", "/a", "/b")))
    assert moved == ["b"]
    assert fleet.story == [
        ("stated", 0, 2, ["a.rv", "b.rv", "c.rv"], ("b",)),
        ("withdrawn", "/b", 1),
        ("stated", 0, 2, ["a.rv", "b.rv", "c.rv"], ("b",)),
        ("stated", 1, 2, [], ()),
        ("placed", "/b", 0),
    ]
    assert [row["reason"] for row in fleet.trail.rows if row["event"] == "topics moved"] == [
        "/b is handled by another relay process; b started in the initial state there"
    ]


async def test_crossing_moves_go_one_way_and_are_tried_first(fleet: Fleet) -> None:
    files = {name: spec(name, f"/{name}") for name in "abcd"}
    await fleet.rollout.take(revision(2, **files))
    fleet.carried = {(TOPIC, f"/{name}") for name in "abcd"}
    fleet.story.clear()
    await fleet.rollout.take(revision(3, **files, x=spec("x", "/a", "/b"), y=spec("y", "/c", "/d")))
    shadowed = fleet.story[0]
    assert shadowed[:2] == ("stated", 0)
    assert {"a.rv", "b.rv", "c.rv", "d.rv", "x.rv", "y.rv"} == set(shadowed[3])
    assert {one[2] for one in fleet.story if one[0] == "placed"} == {0}


async def test_a_relay_that_starts_during_a_load_gets_it_before_any_topic(
    fleet: Fleet,
) -> None:
    """Otherwise topics would bypass the monitors that moved to this relay until it has compiled them."""
    relay, fleet.away = 0, {0}
    stated: list[messages.SpecificationsStated] = []

    def answer(at: int, statement: messages.SpecificationsStated) -> messages.Message:
        fleet.away = set()
        stated.append(fleet.rollout.statement(relay))
        return taken(statement)

    fleet.files["c"] = spec("c", "/c")
    fleet.answer = answer
    await fleet.rollout.take(revision(2, **fleet.files))
    assert stated[0].revision == 2


async def test_a_load_ends_once_the_relays_that_lost_topics_confirm(fleet: Fleet) -> None:
    fleet.answer = lambda relay, statement: None if relay == 1 else taken(statement)
    await fleet.rollout.take(revision(2, **fleet.files, c=spec("c", "/a", "/b")))
    over = asyncio.ensure_future(fleet.rollout.all_taken())
    for _ in range(5):
        await asyncio.sleep(0)
    assert not over.done()
    fleet.rollout.received(taken([one for at, one in fleet.stated if at == 1][-1]), 1)
    await over
    assert fleet.rollout.refused == []


async def test_a_topic_published_during_a_load_moves_as_well(fleet: Fleet) -> None:
    fleet.carried = set()

    def answer(_relay: int, statement: messages.SpecificationsStated) -> messages.Message:
        fleet.carried = {(TOPIC, "/b")}
        return taken(statement)

    fleet.answer = answer
    await fleet.rollout.take(revision(2, **fleet.files, c=spec("c", "/a", "/b")))
    assert ("withdrawn", "/b", 1) in fleet.story
    assert fleet.story[-1] == ("placed", "/b", 0)


async def test_a_compiler_that_fails_during_a_load_leaves_no_relay_with_it(fleet: Fleet) -> None:
    async def parts(_compiled: bytes, _wanted: object) -> list[bytes]:
        raise SpecificationsRefusedError(["the compiler has failed"])

    def answer(_relay: int, statement: messages.SpecificationsStated) -> messages.Message:
        fleet.carried, fleet.rollout.parts = {(TOPIC, "/c")}, parts  # now c.rv belongs to the other relay
        return taken(statement)

    fleet.answer = answer
    with pytest.raises(SpecificationsRefusedError, match="the compiler has failed"):
        await fleet.rollout.take(revision(2, **fleet.files, c=spec("c", "/c")))
    assert {relay: message.revision for relay, message in fleet.stated} == {0: 1, 1: 1}


async def test_an_answer_to_an_earlier_try_does_not_count(
    fleet: Fleet, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("appliance.specifications.rollout._RELAY_SECONDS", 0.01)
    fleet.answer = lambda _relay, _statement: None
    with pytest.raises(SpecificationsRefusedError, match="try again"):
        await fleet.rollout.take(revision(2, **fleet.files, c=spec("c", "/b")))
    late = [one for _, one in fleet.stated if one.revision == 2]
    monkeypatch.setattr("appliance.specifications.rollout._RELAY_SECONDS", 15)
    again = asyncio.ensure_future(fleet.rollout.take(revision(2, **fleet.files, d=spec("d", "/b"))))
    await asyncio.sleep(0)
    for relay, statement in enumerate(late):
        fleet.rollout.received(taken(statement), relay)
    for _ in range(5):
        await asyncio.sleep(0)
    assert not again.done()
    for relay, statement in fleet.stated[-2:]:
        fleet.rollout.received(taken(statement), relay)
    await again


async def test_monitors_in_their_initial_state_are_reported(fleet: Fleet) -> None:
    fleet.answer = lambda relay, statement: messages.SpecificationsTaken(
        statement.revision, ["c", "b"] if relay else [], [], statement.statement
    )
    fleet.rollout.received(messages.SpecificationsTaken(1, ["a"], []), 0)
    await fleet.rollout.take(revision(2, **fleet.files, c=spec("c", "/b")))
    assert fleet.rollout.began(["a", "b", "c"]) == ["b", "c"]


async def test_held_monitors_and_rows_of_both(fleet: Fleet) -> None:
    rollout = fleet.rollout

    def row(name: str, events: int) -> messages.MonitorRow:
        return messages.MonitorRow(name, f"{name}.rv", events=events)

    rollout.received(messages.SpecificationsTaken(1, ["a"], ["a"]), 0)
    rollout.received(messages.SpecificationsTaken(1, ["b"], ["b"]), 1)
    rollout.received(messages.MonitorsCounted([row("a", 1), row("b", 9)]), 0)
    rollout.received(messages.MonitorsCounted([row("b", 2)]), 1)
    assert rollout.held == {"a", "b"}
    assert {name: one.events for name, one in rollout.rows.items()} == {"a": 1, "b": 2}
    rollout.resumed("b")
    assert rollout.held == {"a"}


async def test_a_relay_with_other_specifications_is_reported_until_it_agrees(fleet: Fleet) -> None:
    rollout = fleet.rollout
    rollout.received(messages.SpecificationsRefused(1, ["no memory"]), 1)
    rollout.received(messages.SpecificationsTaken(1, ["a"], []), 0)
    assert rollout.refused == ["no memory"]
    rollout.received(messages.SpecificationsTaken(1, ["b"], []), 1)
    assert rollout.refused == []


async def test_a_crash_of_control_changes_nothing() -> None:
    kept: list[str] = []
    allocation = Allocation(2, kept.append)
    files = {"b": spec("b", "/b"), "z": spec("z", "/z")}
    allocation.adopt(allocation.plan(revision(1, **files).checked))
    here = {name: allocation.of_file(f"{name}.rv") for name in files}
    after = Fleet().rollout
    await after.start(revision(1, **files), restarted=True, kept=kept[-1])
    assert {name: after.relay_of(name) for name in files} == here
    assert after.statement(0).restarted is True


@pytest.mark.nightly
async def test_a_crash_during_a_change_leaves_no_topic_without_its_monitors() -> None:
    kept: list[str] = []
    allocation = Allocation(2, kept.append)
    names = [f"/t{number}" for number in range(20)]
    files = {f"x{number}": spec(f"x{number}", name) for number, name in enumerate(names)}
    before = revision(1, **files)
    allocation.adopt(allocation.plan(before.checked))
    allocation.adopt(allocation.plan(revision(2).checked))
    after = Fleet().rollout
    await after.start(before, restarted=True, kept=kept[-1])
    for number, name in enumerate(names):
        assert after.relay_of(f"x{number}") == after.allocation.of(TOPIC, name)


async def test_a_withdrawn_load_leaves_nothing_in_memory(fleet: Fleet) -> None:
    before = dict(fleet.rollout.compiled_parts)
    with withdrawable(lambda: True), pytest.raises(WithdrawnError):
        await fleet.rollout.take(revision(2, **fleet.files, c=spec("c", "/c")))
    assert fleet.rollout.compiled_parts == before
    assert not fleet.stated


async def test_each_relay_inherits_once(fleet: Fleet) -> None:
    done: list[bool] = []
    fleet.rollout.inherit(InheritedState(left=(b"state",)), lambda: done.append(True))
    first, again = (fleet.rollout.statement(0) for _ in range(2))
    assert (first.left, again.left) == ((b"state",), (b"state",))
    fleet.rollout.received(taken(again), 0)
    assert fleet.rollout.statement(0).left == ()
    assert done == []
    fleet.rollout.received(taken(fleet.rollout.statement(1)), 1)
    assert done == [True]
    assert fleet.rollout.statement(1).left == ()


@pytest.mark.parametrize("copied", [True, False])
async def test_each_relay_gives_only_its_own_state(fleet: Fleet, copied: bool) -> None:
    """The numbers of questions follow each other, so a relay knows those of the others."""
    rollout = fleet.rollout
    states: Awaitable[Sequence[Any]] = rollout.copies(2, full=True) if copied else rollout.leave(2)
    waiting = asyncio.ensure_future(states)
    await asyncio.sleep(0)
    first, second = fleet.wanted
    for relay, number, content in (
        (1, first, b"forged"),
        (0, second, b"forged"),
        (1, second, b"b"),
        (0, first, b"a"),
    ):
        rollout.received(messages.StateLeft(number, content, 1), relay)
    assert [getattr(one, "content", one) for one in await waiting] == [b"a", b"b"]


async def test_each_relay_counts_only_its_own_monitors(fleet: Fleet) -> None:
    rollout = fleet.rollout
    for relay, events in ((1 - rollout.relay_of("a"), 9), (rollout.relay_of("a"), 1)):
        rows = [messages.MonitorRow("a", file, events=events) for file in ("a.rv", "b.rv", "")]
        for row in rows if events == 9 else rows[:1]:
            rollout.received(messages.MonitorsCounted([row]), relay)
            assert {row.events for row in rollout.rows.values()} == (set() if events == 9 else {1})
