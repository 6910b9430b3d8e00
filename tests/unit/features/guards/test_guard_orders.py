from collections import Counter
from types import SimpleNamespace
from typing import Any

import msgspec
import pytest

from appliance.base import clock
from appliance.channel import admin
from appliance.channel.answers.graph_answers import Graph, Node, Publisher, Topic
from appliance.channel.answers.monitor_answers import Replacement
from appliance.channel.messages import MonitorEvent
from appliance.control.errors import SenselessError, UnknownThingError
from appliance.features.guards import guard_orders
from appliance.features.guards import requests as guard_requests
from appliance.features.guards.guard_answers import LastStop
from appliance.features.guards.guard_orders import GuardOrders
from appliance.features.guards.message_types import GOAL
from appliance.features.guards.presets import PRESETS, Guard, text_of
from appliance.features.guards.released import released
from appliance.features.guards.upgrades import Upgrade
from appliance.features.guards.view import ActingGuard, GuardsState
from appliance.specifications.episodes import Stops
from appliance.specifications.specification_files import SpecificationsRefusedError
from tests.support.core import FakeTrail
from tests.support.virtual_clock import let_time_pass
from tests.unit.features.guards.test_placement import Connections

pytestmark = pytest.mark.anyio
TYPES = {"command": "geometry_msgs/Twist", "by": "nav_msgs/Odometry"}
FENCE = Guard("fence", PRESETS["fence"], types=TYPES, values={"polygon": "0,0 1,0 1,1"})


class Manager:
    revision, tag, shadow, off = 2, "2.0", False, False

    def __init__(self) -> None:
        self.orders: list[Any] = []
        self.enabling: list[bool] = []
        self.objection: list[str] = []
        self.sources = SimpleNamespace(files={"fence.rv": text_of(FENCE), "other.rv": "other() { }"})
        self.checked = SimpleNamespace(monitors={"fence": "fence.rv", "other": "other.rv"})
        self.rollout = SimpleNamespace(held=set(), why_held={}, rows={})
        self.switches = SimpleNamespace(
            in_shadow=lambda _name: self.shadow,
            enabled=lambda _name: not (self.shadow or self.off),
            starts_in_shadow=False,
        )
        self.givens = SimpleNamespace(states=lambda _checked, _name: [])
        self.returns = SimpleNamespace(until=lambda _name: None, confirm_by=lambda _name: None)
        self.records = SimpleNamespace(counts=Counter(), stops=Stops(lambda _stops: None))

    async def load(self, request: Any, _who: str, *, enable: bool = False) -> Any:
        self.orders.append(request)
        self.enabling.append(enable)
        return request

    give = load

    async def attempt(self, _request: Any, _who: str) -> Any:
        return SimpleNamespace(warnings=self.judge_shadow(_request))

    def judge_shadow(self, _request: Any) -> list[str]:
        if self.objection:
            raise SpecificationsRefusedError(self.objection)
        return []


@pytest.fixture
def manager() -> Manager:
    return Manager()


@pytest.fixture
def orders(manager: Manager) -> GuardOrders:
    return GuardOrders(manager, lambda: Graph([], [], []), Connections(), FakeTrail())  # type: ignore[arg-type]  # as much as guards need


async def row(orders: GuardOrders) -> Any:
    [found] = (await orders.guards(guard_requests.GuardsWanted())).guards
    return found


async def test_the_status_names_the_guards_that_act_and_since_when(
    manager: Manager, orders: GuardOrders
) -> None:
    orders.look()
    assert orders.state() == GuardsState(1, [])
    began = clock.wall()
    for _second in range(3):  # the pauses are shorter than two seconds
        manager.records.counts["change", "fence"] += 1
        orders.look()
        assert orders.state() == GuardsState(1, [ActingGuard("fence", began)])
        let_time_pass(1.5)
    let_time_pass(2.0)
    orders.look()
    assert orders.state() == GuardsState(1, [])
    manager.sources.files.clear()
    assert orders.state() is None


async def test_a_guard_is_stopping_while_it_acts(manager: Manager, orders: GuardOrders) -> None:
    manager.records.counts["change", "fence"] = 5
    orders.look()
    assert (await row(orders)).state == "free"
    for kind in ("drop", "change", "publish"):
        manager.records.counts[kind, "fence"] += 1
        orders.look()
        assert (await row(orders)).state == "stopping"
        let_time_pass(2.5)
        orders.look()
        assert (await row(orders)).state == "free"
    assert (await row(orders)).stops == 8
    manager.shadow = True
    assert ((await row(orders)).state, (await row(orders)).stops) == ("shadow", 0)
    manager.rollout.held.add("fence")
    assert (await row(orders)).state == "holding"


async def test_a_guard_has_its_last_stop(manager: Manager, orders: GuardOrders) -> None:
    assert (await row(orders)).last_stop is None
    stops, now = manager.records.stops, clock.now()
    for second in (5, 7):
        event = MonitorEvent(
            "change", "fence", "k", "/cmd_vel", second * 10**9, "", {"cause": "at the edge"}, host="10.0.0.7",
            caller_id="/teleop", safe=True,
        )  # fmt: skip
        if (begun := stops.take(event, now)) is not None:
            stops.recorded(begun, "18e9")
    going_on = LastStop(5, None, 2, "at the edge", "10.0.0.7", "/teleop", "18e9")
    assert (await row(orders)).last_stop == going_on
    stops.ended(now + 10)
    assert (await row(orders)).last_stop == msgspec.structs.replace(going_on, until=7)


async def test_a_guard_is_withholding_while_its_relay_says_so(manager: Manager, orders: GuardOrders) -> None:
    manager.rollout.rows["fence"] = SimpleNamespace(withholds=True, awaits="")
    assert (await row(orders)).state == "withholding"


async def test_a_guard_has_the_digest_of_its_preset_text_and_values(
    manager: Manager, orders: GuardOrders
) -> None:
    before = (await row(orders)).digest
    assert len(before) == 16 and (await row(orders)).digest == before
    manager.sources.files["fence.rv"] = text_of(FENCE).replace("<= silent", "<= 1e9", 1)
    assert (await row(orders)).digest != before


async def test_each_change_of_a_guard_is_recorded_with_its_digest(manager: Manager) -> None:
    trail = FakeTrail()
    orders = GuardOrders(manager, lambda: Graph([], [], []), Connections(), trail)  # type: ignore[arg-type]  # as much as guards need

    def recorded() -> list[Any]:
        orders.look()
        return [one.detail for one in trail.records if one.event == "guard loaded"]

    [first] = recorded()
    assert first["digest"] == (await row(orders)).digest
    assert (first["monitor"], first["preset"], first["origin"]) == ("fence", "fence", "current")
    assert first["values"]["polygon"] == "0,0 1,0 1,1"
    manager.tag = "3.0"
    assert recorded() == [first]  # something else was changed
    other = Guard("fence", PRESETS["fence"], types=TYPES, values={"polygon": "0,0 2,0 2,2"})
    manager.tag, manager.sources.files["fence.rv"] = "4.0", text_of(other)
    _, second = recorded()
    assert second["digest"] == (await row(orders)).digest != first["digest"]
    assert second["values"]["polygon"] == "0,0 2,0 2,2"


async def test_a_guard_names_the_nodes_that_it_awaits(manager: Manager, orders: GuardOrders) -> None:
    manager.rollout.rows["fence"] = SimpleNamespace(withholds=False, awaits="/lidar on /scan")
    assert (await row(orders)).awaits == "/lidar on /scan"


async def test_the_topic_that_cancels_goals_is_not_one_to_make_the_guard_with(
    manager: Manager, orders: GuardOrders
) -> None:
    stop = Guard("fence", PRESETS["estop"], {"command": "/arm/goal"}, {"command": GOAL})
    manager.sources.files["fence.rv"] = text_of(stop)
    topics = {"command": "/arm/goal", "cancel": "/arm/cancel", "stop": "/s", "reset": "/r"}
    manager.givens.states = lambda _checked, _name: [
        SimpleNamespace(name=name, value=topic, kind="topic") for name, topic in topics.items()
    ]
    assert (await row(orders)).topics.keys() == PRESETS["estop"].given_topics.keys()


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
    manager: Manager, orders: GuardOrders, request_: Any, loads: str, changed: Any
) -> None:
    manager.givens.states = lambda _checked, _name: [SimpleNamespace(name="margin", value=0.2, kind="double")]
    manager.shadow = True
    plan = await orders.plan(guard_requests.GuardTry(**{"name": "fence", **request_}), "eve")
    assert (plan.file, plan.begins, plan.changed) == (loads, loads == "yard.rv", changed)
    assert plan.shadow is not (request_.keys() > {"topics"} or "enforce" in request_)
    assert plan.acts.keys() == ({"command", "by"} if loads == "yard.rv" else set())
    manager.objection = ["fence would hold /cmd_vel"]
    plan = await orders.plan(guard_requests.GuardTry(**{"name": "fence", **request_}), "eve")
    assert plan.refused == ([] if not loads and "enforce" not in request_ else manager.objection)
    assert manager.orders == []


async def test_a_plan_promises_no_force_that_the_settings_withhold(
    manager: Manager, orders: GuardOrders
) -> None:
    manager.off = True
    plan = await orders.plan(guard_requests.GuardTry(name="fence", values={"polygon": "0,0 2,0 2,2"}), "eve")
    assert (plan.off, plan.shadow) == (True, False)
    manager.switches.starts_in_shadow = True
    topics = {"command": "/c", "by": "/o"}
    plan = await orders.plan(guard_requests.GuardTry("fence", topics, TYPES, "yard"), "eve")
    assert (plan.off, plan.shadow) == (False, True)


async def test_values_are_set_in_one_change(manager: Manager, orders: GuardOrders) -> None:
    manager.shadow = True
    values = {"polygon": "0,0 2,0 2,2", "margin": "0.5"}
    await orders.set(guard_requests.GuardSet("fence", values, "2.0"), "eve")
    [load] = manager.orders
    assert "\n    polygon = 0,0 2,0 2,2;\n" in load.files["fence.rv"]
    assert (load.given, load.shadow, load.expected) == ({"fence": {"margin": "0.5"}}, True, "2.0")
    manager.orders.clear()
    await orders.set(guard_requests.GuardSet("fence", {"margin": "0.5"}), "eve")
    assert manager.orders == [admin.MonitorGive("fence", {"margin": "0.5"})]


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
    manager: Manager, orders: GuardOrders, request_: Any, why: str
) -> None:
    act = orders.new if isinstance(request_, guard_requests.GuardNew) else orders.set
    with pytest.raises(SenselessError, match=why):
        await act(request_, "eve")
    assert not manager.orders


async def test_a_new_guard_acts_behind_an_old_one_and_a_wrong_order_is_reported(
    manager: Manager, orders: GuardOrders
) -> None:
    types = {"command": TYPES["command"]}
    request = guard_requests.GuardNew("speed", {"command": "/cmd_vel"}, types=types, name="cap")
    await orders.new(request, "eve")
    assert "\norder " not in manager.orders.pop().files["cap.rv"]  # both have phases
    manager.sources.files["fence.rv"] = released("fence", 2).text
    await orders.new(request, "eve")
    [load] = manager.orders
    assert load.files["cap.rv"].endswith("\norder fence < cap;\n")
    assert (await orders.guards(guard_requests.GuardsWanted())).warnings == []
    manager.sources.files["cap.rv"] = load.files["cap.rv"]
    manager.checked.monitors = {"cap": "cap.rv", **manager.checked.monitors}
    [warning] = (await orders.guards(guard_requests.GuardsWanted())).warnings
    assert "cap acts before fence" in warning


async def test_an_upgrade_beside_old_guards_reports_a_wrong_order(
    manager: Manager, orders: GuardOrders, monkeypatch: pytest.MonkeyPatch
) -> None:
    async def load(order: Any, _who: str) -> Replacement:
        manager.sources.files |= order.files
        return Replacement(3, "3.0", 1, [], [], [], [], [], [], [], None)

    monkeypatch.setattr(manager, "load", load)
    manager.sources.files = {"cap.rv": released("speed", 1).text, "fence.rv": released("fence", 2).text}
    manager.checked.monitors = {"cap": "cap.rv", "fence": "fence.rv"}
    new = Upgrade(text_of(FENCE), {}, [])
    monkeypatch.setattr(guard_orders, "upgraded", lambda *_given: new)
    [warning] = (await orders.upgrade(guard_requests.GuardUpgrade("fence"), "eve")).warnings
    assert "cap acts before fence" in warning


async def test_a_type_of_an_unknown_topic_is_refused(manager: Manager, orders: GuardOrders) -> None:
    for preset, name, why in (
        ("speed", "by", "speed: by is not one of its topics; give the type of command"),
        ("arm", "fix", "arm: fix always has the same type; give the type of command, by"),
    ):
        types = {"command": TYPES["command"], name: "nav_msgs/Odometry"}
        request = guard_requests.GuardNew(preset, {"command": "/c", "by": "/b"}, types=types, name="x")
        with pytest.raises(SenselessError, match=why):
            await orders.new(request, "eve")
    assert not manager.orders


async def test_a_monitor_that_is_not_a_guard_is_unknown(orders: GuardOrders) -> None:
    with pytest.raises(UnknownThingError, match="the guards are: fence"):
        await orders.set(guard_requests.GuardSet("other", {"margin": "1"}), "eve")


@pytest.mark.parametrize("shadow", [True, False])
async def test_a_new_guard_is_in_shadow_mode_or_in_force(
    manager: Manager, orders: GuardOrders, shadow: bool
) -> None:
    """It is enabled even with `enable: none`, as in the package, because it would stop nothing otherwise."""
    request = guard_requests.GuardNew("speed", {"command": "/c"}, {"vMax": "0.3"}, {"command": TYPES["command"]},
                                      shadow=shadow, confirm_within=300.0)  # fmt: skip
    await orders.new(request, "eve")
    [load] = manager.orders
    assert manager.enabling == [not shadow]
    assert "\n    vMax = 0.3;\n" in load.files["speed.rv"]
    assert (load.shadow, load.confirm_within, load.note[:14]) == (shadow, 300.0, "preset speed 2")


async def test_suggestions_name_the_guards_that_are_loaded(manager: Manager) -> None:
    flow = {
        "messages": 0,
        "bytes": 0,
        "dropped": 0,
        "messages_per_second": 10.0,
        "bytes_per_second": 0.0,
        "delay_seconds": 0.0,
    }
    topics = [
        Topic(name, kind, True, [Publisher(node="/a", **flow)], ["/base"], [])  # type: ignore[arg-type]  # of floats
        for name, kind in (
            ("/cmd_vel", TYPES["command"]),
            ("/odom", TYPES["by"]),
            ("/estop_enabled", "std_msgs/Bool"),
        )
    ]
    given = [SimpleNamespace(name=name, kind="topic", value=topic) for name, topic in
             (("command", "/cmd_vel"), ("by", "/odom"))]  # fmt: skip
    manager.givens = SimpleNamespace(states=lambda _checked, _name: given)
    orders = GuardOrders(manager, lambda: Graph([], topics, []), Connections(), FakeTrail())  # type: ignore[arg-type]  # as much as guards need
    found = await orders.suggestions(guard_requests.GuardSuggestionsWanted())
    assert [one.name for one in found.loaded] == ["fence"]
    assert [one.preset for one in found.suggestions] == ["deadman", "speed"]
    assert found.left_out[0].startswith("/estop_enabled: its name does not say")


async def test_a_guard_shows_its_version_and_is_upgraded_once(
    manager: Manager, orders: GuardOrders, monkeypatch: pytest.MonkeyPatch
) -> None:
    shown = await row(orders)
    assert (shown.version, shown.origin) == (PRESETS["fence"].version, "current")
    manager.sources.files["fence.rv"] = text_of(FENCE).replace("<= silent", "<= 1e9", 1)
    assert (await row(orders)).origin == "changed"
    for request in (
        guard_requests.GuardUpgrade("fence"),
        guard_requests.GuardTry(name="fence", upgrade=True),
    ):
        act: Any = orders.plan if isinstance(request, guard_requests.GuardTry) else orders.upgrade
        with pytest.raises(SenselessError, match="was changed after it was made"):
            await act(request, "eve")
    assert not manager.orders
    new = Upgrade("// preset fence 9: by=/odom\nnew text", {"margin": ["0.2", "0.3"]}, ["ahead=1 is kept"])
    monkeypatch.setattr(guard_orders, "upgraded", lambda *_given: new)
    manager.shadow = True
    plan = await orders.plan(guard_requests.GuardTry(name="fence", upgrade=True), "eve")
    assert (plan.file, plan.text, plan.changed, plan.shadow) == ("fence.rv", new.text, new.changed, True)
    assert plan.warnings == new.warnings
    await orders.upgrade(guard_requests.GuardUpgrade("fence", confirm_within=60.0), "eve")
    [load] = manager.orders
    assert (load.files, load.shadow, load.confirm_within) == ({"fence.rv": new.text}, True, 60.0)


async def test_a_new_guard_and_the_list_say_that_the_base_is_on_another_machine(manager: Manager) -> None:
    nodes = [Node("/base", "10.0.0.5", "live", [], ["/c"], [])]
    graph = Graph(nodes, [Topic("/c", TYPES["command"], True, [], ["/base"], [])], [])
    orders = GuardOrders(manager, lambda: graph, Connections(), FakeTrail())  # type: ignore[arg-type]  # as much as guards need
    warning = "/c: the base is on 10.0.0.5: a cut between here and there is not guarded"
    loaded = Replacement(2, "2.0", 1, [], [], [], [], ["another"], [], [], None)
    manager.load = lambda *_given, **_options: _answered(loaded)  # type: ignore[method-assign]  # with warnings
    request = guard_requests.GuardNew("speed", {"command": "/c"}, types={"command": TYPES["command"]})
    assert warning in (await orders.new(request, "eve")).warnings
    plan = guard_requests.GuardTry("speed", {"command": "/c"}, {"command": TYPES["command"]})
    assert warning in (await orders.plan(plan, "eve")).warnings
    manager.givens = SimpleNamespace(states=lambda _checked, _name: [])
    manager.sources.files["fence.rv"] = text_of(Guard("fence", PRESETS["fence"], {"command": "/c"}, TYPES))
    orders.placement.look()
    assert (await orders.guards(guard_requests.GuardsWanted())).warnings == [warning]
    state = orders.state()
    assert state is not None and state.elsewhere == [warning]


async def _answered(answer: Any) -> Any:
    return answer
