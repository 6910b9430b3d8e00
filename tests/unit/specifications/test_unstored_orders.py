"""An order that cannot be stored leaves the specifications in force as they were: in memory, on relays, on the disk."""

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
from appliance.specifications.specification_files import Sources
from appliance.specifications.specification_manager import SpecificationManager
from appliance.store import writer_thread
from appliance.store.changes import Change
from appliance.store.state_file import StateStore
from appliance.store.writer_thread import StoreError
from tests.support.engines import InlineDatabase
from tests.unit.specifications.monitor_desk import B, C, Desk

pytestmark = pytest.mark.anyio

CAP = "cap() given { double speed = 1.0 m/s in 0..2; } { event said() /cmd std_msgs/String '{}' { } }"
ORDERS: dict[str, Callable[[SpecificationManager], Coroutine[Any, Any, object]]] = {
    "load": lambda monitors: monitors.load(
        admin.MonitorLoad({"c.rv": C}, shadow=True, confirm_within=60.0), "eve"
    ),
    "load for good": lambda monitors: monitors.load(admin.MonitorLoad({"c.rv": C}), "eve"),
    "reload": lambda monitors: monitors.reload(admin.MonitorReload(prune=True), "eve"),
    "remove": lambda monitors: monitors.remove(admin.MonitorRemove(["b"]), "eve"),
    "roll back": lambda monitors: monitors.roll_back(admin.MonitorRollback(1), "eve"),
    "bundle": lambda monitors: monitors.take_bundle(Sources({"c.rv": C}), "eve", "a bundle"),
    "disable": lambda monitors: monitors.switch(admin.MonitorSwitch(["a"], False), "eve"),
    "disable for a time": lambda monitors: monitors.switch(
        admin.MonitorSwitch(["a"], False, for_seconds=60.0), "eve"
    ),
    "enable": lambda monitors: monitors.switch(admin.MonitorSwitch(["off"], True), "eve"),
    "shadow": lambda monitors: monitors.shadow(admin.MonitorShadow(["a"], True), "eve"),
    "promote": lambda monitors: monitors.shadow(
        admin.MonitorShadow(["b"], False, confirm_within=60.0), "eve"
    ),
    "set": lambda monitors: monitors.give(admin.MonitorGive("cap", {"speed": 0.5}), "eve"),
}


def full(desk: Desk) -> None:
    def execute(_statements: object, _history: str, _number: int) -> None:
        raise sqlite3.OperationalError("database or disk is full")

    vars(desk.store.database)["_execute"] = execute


def closed(desk: Desk) -> None:
    desk.store.close()


def reopened(desk: Desk) -> StateStore:
    """Return the store as it is once the disk has room again."""
    vars(desk.store.database).pop("_execute", None)
    desk.store.close()
    return StateStore(desk.home, failed=lambda _reason: None, kind=InlineDatabase)


def at_the_next_change(desk: Desk, breaks: Callable[[Desk], None]) -> None:
    keep = desk.store.database.keep

    def breaking(changes: list[tuple[Change, bool]]) -> None:
        del vars(desk.store.database)["keep"]
        breaks(desk)
        keep(changes)

    vars(desk.store.database)["keep"] = breaking


def limits(monitors: SpecificationManager) -> list[int]:
    """Return the ends of an unconfirmed change and of timed switches, without the fractions of a second."""
    switches = [
        (monitors.returns.until(name), monitors.returns.confirm_by(name)) for name in monitors.names()
    ]
    return [round(end or 0) for end in (monitors.confirm_by, *itertools.chain(*switches))]


def on_the_relay(desk: Desk) -> dict[str, Any]:
    """Return the last specifications of the relay, and the messages about them that came later."""
    later: list[messages.Message] = []
    stated: dict[str, Any] = {}
    for message in desk.sent:
        if isinstance(message, messages.SpecificationsStated):
            later, stated = [], msgspec.structs.asdict(message)
        else:
            later.append(message)
    for varying in ("statement", "restarted", "ahead", "moved"):
        stated.pop(varying, None)
    return stated | {"later": later}


@pytest.fixture
def desk(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Desk]:
    monkeypatch.setattr(writer_thread, "_SETTLE_SECONDS", 0.01)
    desk = Desk(tmp_path)
    desk.store = reopened(desk)
    yield desk
    desk.kill()
    desk.close()


def words(now: InForce) -> tuple[Any, ...]:
    return now.number, now.sources, now.switches.said, now.states, now.givens.said


@pytest.mark.parametrize("how", [full, closed])
@pytest.mark.parametrize("order", ORDERS)
async def test_an_order_that_cannot_be_stored_changes_nothing(
    desk: Desk, order: str, how: Callable[[Desk], None]
) -> None:
    monitors = await desk.monitors()
    off = C.replace("c()", "off()").replace("/third", "/fourth")
    await monitors.load(admin.MonitorLoad({"cap.rv": CAP, "off.rv": off}), "eve")
    await monitors.switch(admin.MonitorSwitch(["off"], False, for_seconds=600.0), "eve")
    await monitors.load(admin.MonitorLoad({"b.rv": B}, shadow=True, confirm_within=600.0), "eve")
    before, relay, held = monitors.now, on_the_relay(desk), limits(monitors)
    row = monitors.in_force

    at_the_next_change(desk, how)
    with pytest.raises(StoreError, match="revision 3 of the specifications stays in force"):
        await ORDERS[order](monitors)

    assert (monitors.now, monitors.in_force, limits(monitors)) == (before, row, held)
    assert on_the_relay(desk) == relay
    desk.store = reopened(desk)
    again = await desk.monitors(restarted=True)
    assert words(again.now) == words(before)
    assert (again.in_force, limits(again)) == (row, held)
    assert [one.revision for one in desk.store.monitor_revisions()] == [3, 2, 1]


async def test_a_disabled_period_ends_even_on_a_full_disk(desk: Desk) -> None:
    monitors = await desk.monitors()
    await monitors.switch(admin.MonitorSwitch(["a"], False, for_seconds=0.1), "eve")
    full(desk)
    async with asyncio.timeout(30):
        while not monitors.switches.enabled("a"):
            await asyncio.sleep(0.01)
    assert messages.MonitorSwitched("a", True) in desk.sent


async def test_an_unconfirmed_change_ends_even_on_a_full_disk(desk: Desk) -> None:
    desk.limit_ends.set()
    monitors = await desk.monitors()
    await monitors.load(admin.MonitorLoad({"b.rv": B}, confirm_within=0.1), "eve")
    full(desk)
    desk.store.save_setting("another", "change")  # so that the store fails
    async with asyncio.timeout(30):
        while monitors.names() != ["a"]:
            await asyncio.sleep(0.01)
    desk.store = reopened(desk)
    again = await desk.monitors(restarted=True)
    assert (again.names(), again.confirm_by) == (["a"], None)
