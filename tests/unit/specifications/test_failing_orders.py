"""An order that fails at any step leaves what was in force as it was: in memory, on relays, on the disk.

So does a kill of control before the order is stored; a later one leaves the next value in force.
"""

import asyncio
import itertools
import sqlite3
from collections.abc import Callable, Coroutine, Iterator
from pathlib import Path
from typing import Any

import msgspec
import pytest

from appliance.channel import admin, messages
from appliance.specifications.in_force import InForce
from appliance.specifications.rollout import Rollout
from appliance.specifications.specification_files import Sources, SpecificationsRefusedError
from appliance.specifications.specification_manager import TIMED, SpecificationManager
from appliance.store import writer_thread
from appliance.store.changes import Change
from appliance.store.ends import EndKind
from appliance.store.state_file import StateStore
from appliance.store.writer_thread import StoreError
from tests.support.engines import InlineDatabase
from tests.support.waiting import until
from tests.unit.specifications.monitor_desk import B, C, Desk, SlowCompiler

pytestmark = pytest.mark.anyio

CAP = "cap() given { double speed = 1.0 m/s in 0..2; } { event said() /cmd std_msgs/String '{}' { } }"
Ordered = Callable[[SpecificationManager], Coroutine[Any, Any, object]]
LOADS: dict[str, Ordered] = {
    "load": lambda monitors: monitors.load(
        admin.MonitorLoad({"c.rv": C}, shadow=True, confirm_within=60.0), "eve"
    ),
    "load for good": lambda monitors: monitors.load(admin.MonitorLoad({"c.rv": C}), "eve"),
    "reload": lambda monitors: monitors.reload(admin.MonitorReload(prune=True), "eve"),
    "remove": lambda monitors: monitors.remove(admin.MonitorRemove(["b"]), "eve"),
    "roll back": lambda monitors: monitors.roll_back(admin.MonitorRollback(1), "eve"),
    "bundle": lambda monitors: monitors.take_bundle(Sources({"c.rv": C}), "eve", "a bundle", monitors.tag),
}
ROLLED_OUT: dict[str, Ordered] = LOADS | {
    "shadow": lambda monitors: monitors.shadow(admin.MonitorShadow(["a"], True), "eve"),
    "promote": lambda monitors: monitors.shadow(
        admin.MonitorShadow(["b"], False, confirm_within=60.0), "eve"
    ),
}
ORDERS: dict[str, Ordered] = ROLLED_OUT | {
    "disable": lambda monitors: monitors.switch(admin.MonitorSwitch(["a"], False), "eve"),
    "disable for a time": lambda monitors: monitors.switch(
        admin.MonitorSwitch(["a"], False, for_seconds=60.0), "eve"
    ),
    "enable": lambda monitors: monitors.switch(admin.MonitorSwitch(["off"], True), "eve"),
    "set": lambda monitors: monitors.give(admin.MonitorGive("cap", {"speed": 0.5}), "eve"),
    "confirm": lambda monitors: monitors.confirm(admin.MonitorConfirm(), "eve"),
    "resume": lambda monitors: monitors.resume(admin.MonitorResume(["a"]), "eve"),
}


class KilledError(BaseException):
    """The process of control ended here."""


def kill(*_given: object, **_named: object) -> Any:
    raise KilledError("control is killed")


async def not_compiled(*_order: object) -> Any:
    raise SpecificationsRefusedError(["the compiler has failed"])


def no_compiler(desk: Desk, _monitors: object) -> None:
    desk.check = not_compiled


def no_parts(_desk: object, monitors: SpecificationManager) -> None:
    monitors.rollout.parts = not_compiled


def no_relay(desk: Desk, _monitors: object) -> None:
    desk.findings = ["the relay says no"]


def full(desk: Desk) -> None:
    def execute(_statements: object, _history: str, _number: int) -> None:
        raise sqlite3.OperationalError("database or disk is full")

    vars(desk.store.database)["_execute"] = execute


def no_room(desk: Desk, _monitors: object) -> None:
    full(desk)
    desk.store.save_setting("another", "change")  # so that the store fails


def at_the_next_change(breaks: Callable[[Desk], object]) -> Callable[[Desk, object], None]:
    def broken(desk: Desk, _monitors: object) -> None:
        keep = desk.store.database.keep

        def breaking(changes: list[tuple[Change, bool]]) -> None:
            del vars(desk.store.database)["keep"]
            breaks(desk)
            keep(changes)

        vars(desk.store.database)["keep"] = breaking

    return broken


Fault = Callable[[Desk, SpecificationManager], None]
_STAYS = "revision 3 of the specifications stays in force unconfirmed: "
FAULTS: dict[str, tuple[Fault, dict[str, Ordered], str]] = {
    "no compiler": (no_compiler, LOADS, "the compiler has failed"),
    "no parts": (no_parts, ROLLED_OUT, "the compiler has failed"),
    "no relay": (no_relay, ROLLED_OUT, "the relay says no"),
    "no room": (no_room, ORDERS, _STAYS),
    "full": (at_the_next_change(full), ORDERS, _STAYS),
    "closed": (at_the_next_change(lambda desk: desk.store.close()), ORDERS, _STAYS),
    "killed": (at_the_next_change(kill), ORDERS, "control is killed"),
}


def reopened(desk: Desk) -> StateStore:
    """Return the store as it is once the disk has room again."""
    vars(desk.store.database).pop("_execute", None)
    desk.store.close()
    return StateStore(desk.home, failed=lambda _reason: None, kind=InlineDatabase)


def limits(monitors: SpecificationManager) -> list[int]:
    """Return the ends of an unconfirmed change and of timed switches, without the fractions of a second."""
    switches = [(monitors.until(name), monitors.until(name, of=True)) for name in monitors.names()]
    return [round(end or 0) for end in (monitors.confirm_by, *itertools.chain(*switches))]


def told(statement: messages.SpecificationsStated) -> dict[str, Any]:
    varying = ("statement", "restarted", "ahead", "moved")
    return {name: value for name, value in msgspec.structs.asdict(statement).items() if name not in varying}


def on_the_relay(desk: Desk) -> dict[str, Any]:
    """Return the last specifications of the relay, and the messages about them after those."""
    later: list[messages.Message] = []
    stated: dict[str, Any] = {}
    for message in desk.sent:
        if isinstance(message, messages.SpecificationsStated):
            later, stated = [], told(message)
        else:
            later.append(message)
    return stated | {"later": later}


def words(now: InForce) -> tuple[Any, ...]:
    return now.tag, now.sources, now.switches.said, now.states, now.givens.said, now.returns, now.back_to


@pytest.fixture
def desk(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Desk]:
    monkeypatch.setattr(writer_thread, "_SETTLE_SECONDS", 0.01)
    desk = Desk(tmp_path)
    desk.store = reopened(desk)
    yield desk
    desk.kill()
    desk.close()


async def waiting_for_all_orders(desk: Desk) -> SpecificationManager:
    monitors = await desk.monitors()
    off = C.replace("c()", "off()").replace("/third", "/fourth")
    await monitors.load(admin.MonitorLoad({"cap.rv": CAP, "off.rv": off}), "eve")
    await monitors.switch(admin.MonitorSwitch(["off"], False, for_seconds=600.0), "eve")
    await monitors.load(admin.MonitorLoad({"b.rv": B}, shadow=True, confirm_within=600.0), "eve")
    monitors.received(messages.SpecificationsTaken(3, [], ["a"]))
    await desk.store.until_settled()
    return monitors


@pytest.mark.parametrize(
    ("fault", "order"), [(fault, order) for fault, (_, orders, _) in FAULTS.items() for order in orders]
)
async def test_an_order_that_fails_changes_nothing(desk: Desk, order: str, fault: str) -> None:
    monitors = await waiting_for_all_orders(desk)
    before, row, relay, held = monitors.now, monitors.in_force, on_the_relay(desk), limits(monitors)
    stored = desk.store.monitor_revisions()

    breaks, _orders, why = FAULTS[fault]
    breaks(desk, monitors)
    with pytest.raises((SpecificationsRefusedError, StoreError, KilledError), match=why):
        await ORDERS[order](monitors)

    assert (monitors.now, monitors.in_force) == (before, row)
    if fault != "killed":
        assert (limits(monitors), on_the_relay(desk)) == (held, relay)
        assert order in ROLLED_OUT or monitors.rollout.held == {"a"}
    desk.store, desk.findings = reopened(desk), []
    assert desk.store.monitor_revisions() == stored
    again = await desk.monitors(restarted=True)
    assert (words(again.now), again.in_force, limits(again)) == (words(before), row, held)
    assert told(again.statement(0)) | {"later": []} == relay


@pytest.mark.parametrize(
    "order",
    [*ORDERS, "replace", "reload nothing new", "roll back the next", "a start", "a start after a crash"],
)
async def test_only_a_confirmation_and_a_rollback_end_the_time_to_confirm(desk: Desk, order: str) -> None:
    monitors = await waiting_for_all_orders(desk)
    waits = (monitors.now.back_to, limits(monitors)[0])
    assert all(waits)
    if order == "replace":
        await monitors.replace(admin.MonitorReplace("b", B.replace("other", "b")), "ann")
    elif order == "reload nothing new":
        for _ in range(2):
            await monitors.reload(admin.MonitorReload(), "ann")
    elif order == "roll back the next":
        await ORDERS["load for good"](monitors)
        await monitors.roll_back(admin.MonitorRollback(), "ann")
    elif order in ORDERS:
        await ORDERS[order](monitors)
    else:
        monitors = await desk.monitors(restarted=order == "a start after a crash")
    if order == "load":  # with a time to confirm of its own
        assert (monitors.now.back_to, limits(monitors)[0]) == (waits[0], waits[1] - 540)
    else:
        ends = (None, 0) if order in ("confirm", "roll back") else waits
        assert (monitors.now.back_to, limits(monitors)[0]) == ends


async def test_an_order_that_cannot_be_stored_is_taken_back_without_the_compiler(desk: Desk) -> None:
    """Both files and their topics are on one relay with the new specifications, and on two again without them."""
    desk.relays = 2
    monitors = await desk.monitors()
    await monitors.load(admin.MonitorLoad({"b.rv": B}), "eve")
    before, relays = monitors.now, [told(monitors.statement(relay)) for relay in range(2)]
    joins = "joins() { event one() /chatter std_msgs/String '{}' { } event two() /other std_msgs/String '{}' { } }"

    def breaks(desk: Desk) -> None:
        assert len({monitors.rollout.allocation.of_file(file) for file in ("a.rv", "b.rv")}) == 1
        full(desk)
        no_parts(desk, monitors)

    at_the_next_change(breaks)(desk, monitors)
    with pytest.raises(StoreError, match="revision 2 of the specifications stays in force: "):
        await monitors.load(admin.MonitorLoad({"joins.rv": joins}), "eve")
    assert monitors.now == before
    stated = [told(message) for message in desk.sent if isinstance(message, messages.SpecificationsStated)]
    assert stated[-2:] == relays == [told(monitors.statement(relay)) for relay in range(2)]


@pytest.mark.parametrize("order", ORDERS)
async def test_a_kill_after_an_order_is_stored_leaves_the_next_value(
    desk: Desk, order: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monitors = await waiting_for_all_orders(desk)
    coming: list[InForce] = []

    def stored(_rollout: Rollout, new: InForce) -> None:
        coming.append(new)
        raise KilledError("control is killed")

    with monkeypatch.context() as context:
        context.setattr(Rollout, "adopt", stored)
        with pytest.raises(KilledError):
            await ORDERS[order](monitors)
    desk.store = reopened(desk)
    again = await desk.monitors(restarted=True)
    [new] = coming
    assert words(again.now) == words(new)
    assert (again.confirm_by is not None) == (new.back_to is not None)
    assert set(again.ends.names(TIMED)) == set(new.returns)
    stated = again.statement(0)
    assert stated.enabled == {name: state is not False for name, state in new.states.items()}
    assert set(stated.shadows) == set(new.switches.shadowed_monitors())


async def test_disabled_periods_end_even_on_a_full_disk(desk: Desk) -> None:
    monitors = await desk.monitors()
    await monitors.load(admin.MonitorLoad({"b.rv": B}, shadow=True), "eve")
    await monitors.load(admin.MonitorLoad({"c.rv": C}), "eve")
    await monitors.switch(admin.MonitorSwitch(["c"], False, for_seconds=600.0), "eve")
    await monitors.switch(admin.MonitorSwitch(["a", "b"], False, for_seconds=0.1), "eve")
    full(desk)
    await until(lambda: monitors.now.states == {"a": True, "b": "shadow", "c": False})


@pytest.mark.parametrize("end", ["of a disabled period", "of the time to confirm"])
async def test_an_order_that_is_carried_out_before_an_end_that_is_due_stands_unless_it_goes_back(
    desk: Desk, end: str
) -> None:
    desk.limit_ends.set()
    monitors = await desk.monitors()
    if end == "of a disabled period":
        await monitors.switch(admin.MonitorSwitch(["a"], False, for_seconds=0.1), "eve")
    else:
        await monitors.load(admin.MonitorLoad({"b.rv": B}, confirm_within=0.1), "eve")
    desk.check = slow = SlowCompiler()
    load = asyncio.ensure_future(monitors.load(admin.MonitorLoad({"c.rv": C}), "eve"))
    await slow.begun.wait()
    for_good = asyncio.ensure_future(monitors.switch(admin.MonitorSwitch(["a"], False), "eve"))
    await asyncio.sleep(0)
    await until(lambda: all(monitors.ends.is_over(kind, name) for kind, name in due(monitors)))
    monitors.ends.look()
    await asyncio.sleep(0)
    slow.goes_on.set()
    await asyncio.gather(load, for_good)
    async with monitors.changing(None):  # after what was due
        expected = {"a": False, "c": True} if end == "of a disabled period" else {"a": False}
        assert (monitors.now.states, monitors.now.returns) == (expected, {})


def due(monitors: SpecificationManager) -> list[tuple[EndKind, str]]:
    return [(kind, name) for kind in (TIMED, monitors.unconfirmed) for name in monitors.ends.names(kind)]


async def test_an_unconfirmed_change_ends_even_on_a_full_disk(desk: Desk) -> None:
    desk.limit_ends.set()
    monitors = await desk.monitors()
    await monitors.load(admin.MonitorLoad({"b.rv": B}, confirm_within=0.1), "eve")
    no_room(desk, monitors)
    await until(lambda: monitors.names() == ["a"])
    desk.store = reopened(desk)
    again = await desk.monitors(restarted=True)
    assert (again.names(), again.confirm_by) == (["a"], None)
