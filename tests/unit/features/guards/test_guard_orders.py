from collections.abc import AsyncIterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import msgspec
import pytest

from appliance.base import clock
from appliance.channel import admin
from appliance.channel.answers.graph_answers import Graph, Node, Publisher, Topic
from appliance.channel.messages import (
    GivenValue,
    MonitorEvent,
    MonitorRow,
    MonitorsCounted,
    MonitorsReported,
    SpecificationsTaken,
)
from appliance.configuration.settings import Relay
from appliance.control.errors import SenselessError, UnknownThingError
from appliance.features.guards import requests as guard_requests
from appliance.features.guards.fitness import GuardFitness
from appliance.features.guards.guard_answers import LastStop
from appliance.features.guards.guard_facts import values_of
from appliance.features.guards.guard_orders import GuardOrders
from appliance.features.guards.guard_words import state_in_words, times_in_words
from appliance.features.guards.presets import PRESETS, Guard, former_guard, text_of
from appliance.features.guards.released import released_preset
from appliance.features.guards.robot_graph import GOAL
from appliance.features.guards.upgrades import upgrade_of
from appliance.features.guards.view import GUARDS_VIEW, ActingGuard, GuardsState
from appliance.specifications.specification_files import MonitorsChangedError, SpecificationsRefusedError
from appliance.specifications.specification_manager import SpecificationManager
from appliance.telemetry.audit_trail import AuditTrail
from tests.support.answers import example
from tests.support.core import FakeTrail
from tests.support.virtual_clock import let_time_pass
from tests.unit.features.guards.guard_desk import FENCE, TYPES, monitors_of
from tests.unit.features.guards.test_placement import Connections
from tests.unit.specifications.monitor_desk import Desk

pytestmark = pytest.mark.anyio
FORMER = r"""// preset sane 1: command=/cmd_vel geometry_msgs/Twist
// Stops the base if a command has a number that is infinite or NaN.

begin sane() given {
    topic command = /cmd_vel;
} {
    safe geometry_msgs/Twist { } on command every 100ms;

    event drive(double x, double y, double z, double rx, double ry, double rz) command geometry_msgs/Twist
            '{linear.x:x, linear.y:y, linear.z:z, angular.x:rx, angular.y:ry, angular.z:rz}' {
        if (!isfinite(x) || !isfinite(y) || !isfinite(z) || !isfinite(rx) || !isfinite(ry) || !isfinite(rz)) {
            ROS_WARN_THROTTLE(1.0, "stopped: a velocity is not a finite number");
            STOP;
        }
    }
}
"""
"""A guard of 0.3.0."""
CHANGED = text_of(FENCE).replace("<= silent", "<= 1e9", 1)


@pytest.fixture
async def monitors(tmp_path: Path) -> AsyncIterator[SpecificationManager]:
    async with monitors_of(tmp_path) as monitors:
        yield monitors


class Settings:
    """The settings of a store that a restart keeps."""

    def __init__(self) -> None:
        self.rows: dict[str, str] = {}

    def settings(self) -> dict[str, str]:
        return self.rows

    def save_setting(self, name: str, value: str) -> None:
        self.rows[name] = value


def orders_of(
    monitors: SpecificationManager,
    trail: AuditTrail | None = None,
    graph: Graph | None = None,
    store: Any = None,
    relay: Relay | None = None,
) -> GuardOrders:
    present, trail = Graph([], [], []) if graph is None else graph, trail or FakeTrail()
    settings: Any = store or Settings()
    fitness = GuardFitness(monitors, relay or Relay(), 1, trail, settings)
    return GuardOrders(monitors, lambda: present, Connections(), trail, fitness, tests={})


@pytest.fixture
def orders(monitors: SpecificationManager) -> GuardOrders:
    return orders_of(monitors)


async def load(monitors: SpecificationManager, *guards: Guard, **files: str) -> None:
    """Load guards, and texts as the files NAME.rv."""
    texts = {f"{guard.name}.rv": text_of(guard) for guard in guards}
    texts |= {f"{name}.rv": text for name, text in files.items()}
    await monitors.load(admin.MonitorLoad(texts), "eve")


async def set_shadow(monitors: SpecificationManager) -> None:
    await monitors.shadow(admin.MonitorShadow(["fence"], True), "eve")


def act(monitors: SpecificationManager, kind: str = "change", second: int = 0, ahead: int = 0) -> None:
    """Report an action of the fence. The system clock is `ahead` of that of monitors, in seconds."""
    event = MonitorEvent(
        kind, "fence", "k", "/cmd_vel", second * 10**9, "", {"cause": "at the edge"}, host="10.0.0.7",
        caller_id="/teleop", safe=True,
    )  # fmt: skip
    monitors.received(MonitorsReported([event], ahead=ahead * 10**9))


def given(monitors: SpecificationManager) -> dict[str, object]:
    return {state.name: state.value for state in monitors.givens.states(monitors.checked, "fence")}


async def row(orders: GuardOrders) -> Any:
    [found] = (await orders.guards(guard_requests.GuardsWanted())).guards
    return found


async def test_the_status_names_the_guards_that_act_and_since_when(
    monitors: SpecificationManager, orders: GuardOrders
) -> None:
    orders.look()
    assert orders.state() == GuardsState(1, [])
    began = clock.wall()
    for _second in range(3):  # the pauses are shorter than two seconds
        act(monitors)
        orders.look()
        assert orders.state() == GuardsState(1, [ActingGuard("fence", began, "at the edge")])
        let_time_pass(1.5)
    let_time_pass(2.0)
    orders.look()
    assert orders.state() == GuardsState(1, [])
    await monitors.remove(admin.MonitorRemove(["fence.rv"]), "eve")
    assert orders.state() is None


async def test_a_guard_is_stopping_while_it_acts(monitors: SpecificationManager, orders: GuardOrders) -> None:
    for _ in range(5):
        act(monitors)
    orders.look()
    assert (await row(orders)).state == "free"
    for kind in ("drop", "change", "publish"):
        act(monitors, kind)
        orders.look()
        assert (await row(orders)).state == "stopping"
        let_time_pass(2.5)
        orders.look()
        assert (await row(orders)).state == "free"
    assert (await row(orders)).stops == 8
    await set_shadow(monitors)
    assert ((await row(orders)).state, (await row(orders)).stops) == ("shadow", 0)
    monitors.received(SpecificationsTaken(monitors.revision, [], ["fence"]))
    assert (await row(orders)).state == "holding"


async def test_a_guard_whose_file_has_an_error_says_so_in_each_state(tmp_path: Path) -> None:
    desk = Desk(tmp_path)
    (desk.folder / "a.rv").unlink()
    (desk.folder / "fence.rv").write_text(text_of(FENCE).replace("<= silent", "<= missing", 1))
    monitors = await desk.monitors()
    orders = orders_of(monitors)
    for state in ("broken", "shadow", "off", "holding"):
        if state == "shadow":
            await set_shadow(monitors)
        elif state == "off":
            await monitors.switch(admin.MonitorSwitch(["fence"], False), "eve")
        elif state == "holding":
            monitors.received(SpecificationsTaken(monitors.revision, [], ["fence"]))
        found = await row(orders)
        words = state_in_words(found)
        assert (found.state, "unknown variable `missing`" in words, words.rpartition(": ")[2]) == (
            state, True, "rosrv monitor load fence.rv"
        )  # fmt: skip
    desk.kill()
    desk.close()


@pytest.mark.parametrize("ahead", [0, 86_400])
async def test_a_guard_has_its_last_stop(
    monitors: SpecificationManager, orders: GuardOrders, ahead: int
) -> None:
    """A clock that was set since the start of the relay shows in its times, and not in its length."""
    assert (await row(orders)).last_stop is None
    for second in (5, 7):
        act(monitors, second=second, ahead=ahead if second == 7 else 0)
    record = monitors.records.stops.last["fence"].record
    going_on = LastStop(5 + ahead, None, 2, "at the edge", "10.0.0.7", "/teleop", record)
    assert record and (await row(orders)).last_stop == going_on
    let_time_pass(10.0)
    monitors.records.tick()
    assert (await row(orders)).last_stop == msgspec.structs.replace(going_on, until=7 + ahead)


async def test_a_guard_is_withholding_and_names_the_nodes_that_it_awaits_as_its_relay_says(
    monitors: SpecificationManager, orders: GuardOrders
) -> None:
    counted = MonitorRow("fence", "fence.rv", withholds=True, awaits="/lidar on /scan")
    monitors.received(MonitorsCounted([counted]))
    found = await row(orders)
    assert (found.state, found.awaits) == ("withholding", "/lidar on /scan")


async def test_a_guard_has_the_digest_of_its_preset_text_and_values(
    monitors: SpecificationManager, orders: GuardOrders
) -> None:
    before = (await row(orders)).digest
    assert len(before) == 16 and (await row(orders)).digest == before
    await load(monitors, fence=CHANGED)
    assert (await row(orders)).digest != before


async def test_each_change_of_a_guard_is_recorded_with_its_digest(monitors: SpecificationManager) -> None:
    trail = FakeTrail()
    orders = orders_of(monitors, trail)

    def recorded() -> list[Any]:
        orders.look()
        return [record.detail for record in trail.records if record.event == "guard loaded"]

    [first] = recorded()
    assert first["digest"] == (await row(orders)).digest
    assert (first["monitor"], first["preset"], first["origin"]) == ("fence", "fence", "current")
    assert first["values"]["polygon"] == "0,0 1,0 1,1"
    await monitors.remove(admin.MonitorRemove(["other.rv"]), "eve")
    assert recorded() == [first]
    await load(monitors, replace(FENCE, values={"polygon": "0,0 2,0 2,2"}))
    _, second = recorded()
    assert second["digest"] == (await row(orders)).digest != first["digest"]
    assert second["values"]["polygon"] == "0,0 2,0 2,2"


def timed(monitors: SpecificationManager, count: int, late: int = 0, latest: float = 0.001) -> None:
    row = MonitorRow("fence", "fence.rv", timed=count, late=late, latest=latest)
    monitors.received(MonitorsCounted([row]))


async def test_delays_of_a_guard_add_up_over_restarts_of_the_relay_and_of_control(
    monitors: SpecificationManager,
) -> None:
    store, relay = Settings(), Relay(late=20.0)
    orders = orders_of(monitors, store=store, relay=relay)
    for count in (100, 200, 50):  # at the last report the relay is another one
        timed(monitors, count, late=count // 100, latest=count / 1e4)
        let_time_pass(1.0)
        orders.look()
    let_time_pass(60.0)
    orders.look()
    again = orders_of(monitors, store=store, relay=relay)
    timed(monitors, 90)
    again.look()
    times = (await row(again)).times
    assert times is not None
    assert (times.timed, times.late, times.latest, times.limit) == (250 + 90, 2, 0.02, 0.02)
    assert 1.0 <= times.seconds <= 4.0
    said = times_in_words(times)
    assert said.startswith(f"in {times.seconds:.0f} s in force since ")
    assert said.endswith("2 of 340 ticks and messages came more than 20 ms late, the latest 20.0 ms")
    other = orders_of(monitors, store=store, relay=Relay(late=50.0))
    timed(monitors, 10)
    other.look()
    times = (await row(other)).times
    assert times is not None
    assert (times.timed, times.limit) == (10, 0.05)


@pytest.mark.parametrize("late", [0, 3])
@pytest.mark.parametrize("unsaved", [0, 40])
@pytest.mark.parametrize("restarted", ["control", "relay", "control and relay"])
async def test_each_tick_counts_once_whatever_restarts(
    monitors: SpecificationManager, restarted: str, unsaved: int, late: int
) -> None:
    store = Settings()
    orders = orders_of(monitors, store=store)
    timed(monitors, 100, late, latest=0.03)
    let_time_pass(60.0)
    alarms_of(orders)
    timed(monitors, 100 + unsaved, late, latest=0.03)
    let_time_pass(59.0)
    alarms_of(orders)
    let_time_pass(3.0)
    trail = FakeTrail()
    if "control" in restarted:
        orders = orders_of(monitors, trail, store=store)
    count = (100 + unsaved, late) if restarted == "control" else (0, 0)
    for more, alarms in ((0, 0), (20, 0), (30, 1)):
        timed(monitors, count[0] + more, count[1] + alarms, latest=0.03)
        assert len(alarms_of(orders)) == alarms
    lost = unsaved if restarted == "control and relay" else 0
    times = (await row(orders)).times
    assert times is not None
    assert (times.timed, times.late) == (100 + unsaved + 30 - lost, late + 1)
    assert [record.event for record in trail.records].count("guard late") == ("control" in restarted)


def alarms_of(orders: GuardOrders) -> list[str]:
    orders.look()
    state = orders.state()
    assert state is not None
    return [alarm.text for alarm in GUARDS_VIEW.states[0].alarms(state) if alarm.kind == "guard-late:fence"]


async def test_a_late_guard_is_an_alarm_for_a_minute_with_one_record(monitors: SpecificationManager) -> None:
    trail = FakeTrail()
    orders = orders_of(monitors, trail)
    timed(monitors, 100)
    assert alarms_of(orders) == []
    for second in range(1, 4):
        timed(monitors, 100 + second, late=second, latest=0.04 + second / 1000)
        alarms = alarms_of(orders)
    assert alarms == [
        "the guard fence acted late 3 times in the last minute (limit 20 ms, longest since its relay began 43.0 ms):"
        " rosrv guard list"
    ]
    assert [record.event for record in trail.records].count("guard late") == 1
    let_time_pass(60.0)
    assert alarms_of(orders) == []


async def test_the_heartbeat_is_off_for_the_reason_of_a_relay(monitors: SpecificationManager) -> None:
    trail = FakeTrail()
    orders = orders_of(monitors, trail, relay=Relay(heartbeat="/rosrv/heartbeat"))
    reasons = []
    for counted in (None, ("", 1), ("fence is disabled", 1), ("fence is disabled", 1), ("", 0), ("", 1)):
        if counted is not None:
            monitors.received(MonitorsCounted([MonitorRow("fence", "fence.rv")], *counted))
        orders.look()
        state = orders.state()
        assert state is not None
        reasons.append(state.heartbeat)
    assert reasons == [
        "a relay process is starting", "", "fence is disabled", "fence is disabled", "no guard is in force", "",
    ]  # fmt: skip
    events = [record.event for record in trail.records if record.event.startswith("heartbeat")]
    assert events == ["heartbeat begun", "heartbeat ended", "heartbeat begun"]
    monitors.rollout.lost(0)
    assert orders.state().heartbeat == "a relay process ended"  # type: ignore[union-attr]  # a heartbeat is set


async def test_the_topic_that_cancels_goals_is_not_one_to_make_the_guard_with(
    monitors: SpecificationManager, orders: GuardOrders
) -> None:
    await load(monitors, Guard("fence", PRESETS["estop"], {"command": "/arm/goal"}, {"command": GOAL}))
    given = {
        state.name for state in monitors.givens.states(monitors.checked, "fence") if state.kind == "topic"
    }
    assert given == (await row(orders)).topics.keys() == PRESETS["estop"].given_topics.keys()


async def test_a_guard_is_shown_with_the_values_in_its_text(orders: GuardOrders) -> None:
    found = await row(orders)
    assert (found.loads, found.types) == ({"polygon": "0,0 1,0 1,1"}, TYPES)


@pytest.mark.parametrize(
    ("request_", "loads", "changed"),
    [
        ({"values": {"margin": "0.5"}}, "", {"margin": ["0.2", "0.5"]}),
        ({"values": {"margin": "0.20"}}, "", {}),
        ({"values": {"polygon": "0,0 2,0 2,2"}}, "fence.rv", {"polygon": ["0,0 1,0 1,1", "0,0 2,0 2,2"]}),
        ({"enforce": True}, "", {}),
        ({"name": "yard", "preset": "fence", "topics": {"command": "/c", "by": "/o"}, "types": TYPES}, "yard.rv", {}),
    ],
)  # fmt: skip
async def test_a_plan_says_what_a_change_would_do(
    monitors: SpecificationManager, monkeypatch: pytest.MonkeyPatch, request_: Any, loads: str, changed: Any
) -> None:
    await set_shadow(monitors)
    orders, before = orders_of(monitors), monitors.tag
    plan = await orders.plan(guard_requests.GuardTry(**{"name": "fence", **request_}), "eve")
    assert (plan.file, plan.begins, plan.changed) == (loads, loads == "yard.rv", changed)
    assert plan.shadow is not (request_.keys() > {"topics"} or "enforce" in request_)
    assert plan.acts.keys() == {"command", "by"}
    refusal = SpecificationsRefusedError(["fence would hold /cmd_vel"])

    def refused(*_judged: object, **_named: object) -> None:
        raise refusal

    monkeypatch.setattr(monitors.judge, "judge", refused)
    plan = await orders.plan(guard_requests.GuardTry(**{"name": "fence", **request_}), "eve")
    assert plan.refused == ([] if not loads and "enforce" not in request_ else refusal.findings)
    assert monitors.tag == before


@pytest.mark.parametrize(
    ("enable", "states"), [("none", [(True, False), (False, False)]), ("shadow", [(False, True)] * 2)]
)
async def test_a_plan_promises_no_force_that_the_settings_withhold(
    tmp_path: Path, enable: str, states: list[tuple[bool, bool]]
) -> None:
    async with monitors_of(tmp_path, enable=enable) as monitors:
        orders = orders_of(monitors)
        changed = guard_requests.GuardTry(name="fence", values={"polygon": "0,0 2,0 2,2"})
        new = guard_requests.GuardTry("fence", {"command": "/c", "by": "/o"}, TYPES, "yard")
        plans = [await orders.plan(request, "eve") for request in (changed, new)]
        assert [(plan.off, plan.shadow) for plan in plans] == states


async def test_values_are_set_in_one_change(monitors: SpecificationManager, orders: GuardOrders) -> None:
    await set_shadow(monitors)
    values = {"polygon": "0,0 2,0 2,2", "margin": "0.5"}
    with pytest.raises(MonitorsChangedError):
        await orders.set(guard_requests.GuardSet("fence", values, "7.0"), "eve")
    await orders.set(guard_requests.GuardSet("fence", values, monitors.tag), "eve")
    assert (monitors.revision, monitors.switches.in_shadow("fence")) == (2, True)
    text = monitors.sources.files["fence.rv"]
    assert "\n    polygon = 0,0 2,0 2,2;\n" in text and "margin = 0.5" not in text
    assert given(monitors)["margin"] == 0.5
    await orders.set(guard_requests.GuardSet("fence", {"margin": "0.25"}), "eve")
    assert (monitors.revision, given(monitors)["margin"]) == (2, 0.25)


@pytest.mark.parametrize(
    ("request_", "why"),
    [
        (guard_requests.GuardNew("fence", {"command": "/cmd_vel", "by": "/odom"}, types=TYPES), "is loaded"),
        (guard_requests.GuardNew("fance", {"command": "/cmd_vel"}), "no preset"),
        (guard_requests.GuardNew("speed", {}), "no `command`"),
        (guard_requests.GuardNew("speed", {"command": "/cmd_vel"}), "no node has the topic"),
        (
            guard_requests.GuardNew(
                "speed", {"command": "/c"}, {"vMax": "99"}, {"command": TYPES["command"]}
            ),
            "outside",
        ),
        (guard_requests.GuardSet("fence", {"margin": "99"}), "outside of"),
    ],
)
async def test_an_order_without_sense_changes_nothing(
    monitors: SpecificationManager, orders: GuardOrders, request_: Any, why: str
) -> None:
    order, before = orders.new if isinstance(request_, guard_requests.GuardNew) else orders.set, monitors.tag
    with pytest.raises(SenselessError, match=why):
        await order(request_, "eve")
    assert monitors.tag == before


async def test_a_guard_of_before_0_4_stays_in_force_as_a_monitor_that_is_named(tmp_path: Path) -> None:
    """Its first line was its only sign of a guard. `rosrv guard` names it, and does not change it."""
    async with monitors_of(tmp_path, {"sane.rv": FORMER}) as monitors:
        orders, why = orders_of(monitors), former_guard("sane", "sane.rv")
        assert monitors.switches.is_enabled("sane")
        listed, state = await orders.guards(guard_requests.GuardsWanted()), orders.state()
        assert (listed.guards, listed.warnings) == ([], [why])
        assert state is not None and (state.loaded, state.former) == (0, {"sane": why})
        [trouble] = GUARDS_VIEW.states[0].alarms(state)
        assert (trouble.kind, trouble.text) == ("guard-older:sane", why)
        with pytest.raises(
            UnknownThingError, match=r"rosrv guard new\), then remove it \(rosrv monitor remove sane.rv"
        ):
            await orders.upgrade(guard_requests.GuardUpgrade("sane"), "eve")
        types = {"command": "geometry_msgs/Twist"}
        await orders.new(guard_requests.GuardNew("sane", {"command": "/c"}, types=types, name="still"), "eve")
        await monitors.remove(admin.MonitorRemove(["sane.rv"]), "eve")
        listed = await orders.guards(guard_requests.GuardsWanted())
        assert ([guard.name for guard in listed.guards], listed.warnings) == (["still"], [])


async def test_a_type_of_an_unknown_topic_is_refused(
    monitors: SpecificationManager, orders: GuardOrders
) -> None:
    for preset, name, why in (
        ("speed", "by", "speed: by is not one of its topics; give the type of command"),
        ("ready", "fix", "ready: fix always has the same type; give the type of command, by"),
    ):
        types = {"command": TYPES["command"], name: "nav_msgs/Odometry"}
        request = guard_requests.GuardNew(preset, {"command": "/c", "by": "/b"}, types=types, name="x")
        with pytest.raises(SenselessError, match=why):
            await orders.new(request, "eve")
    assert monitors.checked.monitors.keys() == {"fence", "other"}


async def test_a_monitor_that_is_not_a_guard_is_unknown(orders: GuardOrders) -> None:
    with pytest.raises(UnknownThingError, match="the guards are: fence"):
        await orders.set(guard_requests.GuardSet("other", {"margin": "1"}), "eve")


@pytest.mark.parametrize("shadow", [True, False])
async def test_a_new_guard_is_in_shadow_mode_or_in_force(tmp_path: Path, shadow: bool) -> None:
    """It is enabled even with `enable: none`, as in the package, because it would stop nothing otherwise."""
    request = guard_requests.GuardNew("speed", {"command": "/c"}, {"vMax": "0.3"}, {"command": TYPES["command"]},
                                      shadow=shadow, confirm_within=300.0)  # fmt: skip
    async with monitors_of(tmp_path, enable="none") as monitors:
        await orders_of(monitors).new(request, "eve")
        switches = monitors.switches
        assert (switches.is_enabled("speed"), switches.in_shadow("speed")) == (not shadow, shadow)
        assert not switches.is_enabled("fence")
        assert "\n    vMax = 0.3;\n" in monitors.sources.files["speed.rv"]
        assert monitors.confirm_by == pytest.approx(clock.wall() + 300.0)
        assert monitors.in_force.note[:14] == "preset speed 3"


async def test_suggestions_name_the_guards_that_are_loaded(monitors: SpecificationManager) -> None:
    publisher = example(Publisher, node="/a", messages_per_second=10.0)
    kinds = {"/cmd_vel": TYPES["command"], "/odom": TYPES["by"], "/estop_enabled": "std_msgs/Bool"}
    topics = [Topic(name, kind, True, [publisher], ["/base"], []) for name, kind in kinds.items()]
    orders = orders_of(monitors, graph=Graph([], topics, []))
    found = await orders.suggestions(guard_requests.GuardSuggestionsWanted())
    assert [one.name for one in found.loaded] == ["fence"]
    assert [suggestion.preset for suggestion in found.suggestions] == ["deadman", "speed"]
    assert found.left_out[0].startswith("/estop_enabled: its name does not say")


async def test_a_guard_shows_its_version_and_a_changed_one_is_not_upgraded(
    monitors: SpecificationManager, orders: GuardOrders
) -> None:
    shown = await row(orders)
    assert (shown.version, shown.origin) == (PRESETS["fence"].version, "current")
    await load(monitors, fence=CHANGED)
    assert (await row(orders)).origin == "changed"
    before = monitors.tag
    with pytest.raises(SenselessError, match="was changed after it was made"):
        await orders.plan(guard_requests.GuardTry(name="fence", upgrade=True), "eve")
    with pytest.raises(SenselessError, match="was changed after it was made"):
        await orders.upgrade(guard_requests.GuardUpgrade("fence"), "eve")
    assert monitors.tag == before


async def test_an_old_guard_is_upgraded_as_it_was_planned(tmp_path: Path) -> None:
    old, name = released_preset("separation", 2).text, "separation"
    async with monitors_of(tmp_path, {"separation.rv": old}) as monitors:
        orders = orders_of(monitors)
        await monitors.shadow(admin.MonitorShadow([name], True), "eve")
        assert (await row(orders)).origin == "older"
        plan = await orders.plan(guard_requests.GuardTry(name=name, upgrade=True), "eve")
        new = upgrade_of(old, values_of(monitors.givens.states(monitors.checked, name)), [], {}, "shadow")
        assert (plan.file, plan.text, plan.changed) == ("separation.rv", new.text, new.changed)
        assert (plan.shadow, plan.warnings) == (True, new.warnings)
        await orders.upgrade(guard_requests.GuardUpgrade(name, confirm_within=60.0), "eve")
        assert monitors.sources.files["separation.rv"] == new.text
        assert monitors.switches.in_shadow(name)
        assert monitors.confirm_by == pytest.approx(clock.wall() + 60.0)


async def test_a_new_guard_and_the_list_say_that_the_base_is_on_another_machine_and_commands_itself(
    monitors: SpecificationManager,
) -> None:
    nodes = [Node("/base", "10.0.0.5", "live", [], ["/c"], [])]
    own = example(Publisher, node="/base", messages_per_second=10.0)
    topics = [Topic("/c", TYPES["command"], True, [own], ["/base"], [])]
    orders = orders_of(monitors, graph=Graph(nodes, topics, []))
    warning = "/c: the base is on 10.0.0.5: a cut between here and there is not guarded"
    inside = "/base also publishes /c to itself, as nodelets of one manager do: no guard gets these"
    plan = guard_requests.GuardTry("speed", {"command": "/c"}, {"command": TYPES["command"]})
    assert {warning, inside} <= {*(await orders.plan(plan, "eve")).warnings}
    request = guard_requests.GuardNew("speed", {"command": "/c"}, types={"command": TYPES["command"]})
    assert {warning, inside} <= {*(await orders.new(request, "eve")).warnings}
    orders.placement.look()
    assert (await orders.guards(guard_requests.GuardsWanted())).warnings == [warning, inside]
    state = orders.state()
    assert state is not None and state.elsewhere == [warning]
    given: dict[str, dict[str, GivenValue]] = {"speed": {"command": "/d"}}
    await monitors.load(
        admin.MonitorLoad({"speed.rv": monitors.sources.files["speed.rv"]}, given=given), "eve"
    )
    orders.placement.look()
    assert (await orders.guards(guard_requests.GuardsWanted())).warnings == []
