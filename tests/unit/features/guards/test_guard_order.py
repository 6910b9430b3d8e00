import math
import re
from collections.abc import Callable
from itertools import product

import pytest

from appliance.features.guards.guard_order import PRECEDENCES
from appliance.features.guards.presets import PRESETS, Guard, text_of
from appliance.features.guards.robot_graph import GOAL
from rosmop.check.sources import compiled_from
from rosmop.run.engine import MonitorSet
from rosmop.tests.acting import fields, message
from tests.support.features.guards.running_guard import DEFINITIONS
from tests.unit.features.guards.guarding import Guarded, twist
from tests.unit.features.guards.test_watching_presets import button, with_id


def together(
    first: str, last: str, types: dict[str, str] | None = None, *, ordered: bool, **values: dict[str, object]
) -> Guarded:
    """Return a base behind two guards, of which `last` acts first by its name; `ordered`: they have their phases."""
    goal = {"command": "/move_base/goal"} if types else {}
    files = {}
    for name, preset in (("a", PRESETS[last]), ("z", PRESETS[first])):
        given = {value: str(text) for value, text in values.get(preset.name, {}).items()}
        kinds = {"command": next(iter(preset.topics["command"])), **(types or {})}
        text = text_of(Guard(name, preset, goal, kinds, given))
        files[f"{name}.rv"] = text if ordered else re.sub(r" in \w+ given \{", " given {", text, count=1)
    monitors = MonitorSet.of(compiled_from(files, DEFINITIONS))
    return Guarded.by(monitors, PRESETS[last].given_topics | PRESETS[first].given_topics | goal)


def jumps(ordered: bool) -> bool:
    guards = together("sensor", "speed", ordered=ordered, speed={"aMax": 1})
    for at in range(100, 1500, 100):
        guards.tell("by", seen(at), at)
        guards.drive(twist(0.5), at)
    for at in range(1500, 2100, 100):
        guards.drive(twist(0.5), at)
    guards.tell("by", seen(3.0), 2150)
    return guards.drive(twist(0.5), 2200)[0] > 0.3


def seen(metres: float, blind: int = 0) -> bytes:
    """Return a scan of things at some distance, which differ from scan to scan; its first rays may be blind."""
    ranges = [math.nan] * blind + [4.0 + metres / 1e6] * (72 - blind)
    return message("sensor_msgs/LaserScan", range_min=0.1, range_max=9.0, ranges=ranges,
                   angle_min=-math.pi, angle_increment=math.pi / 36)  # fmt: skip


def misses_a_base_that_moves(ordered: bool) -> bool:
    """The scanner falls silent, so the sensor stops the base once; the base drives on."""
    guards = together("sensor", "standstill", ordered=ordered)
    guards.topics["measure"] = "/odom"

    def measured(speed: float, at: int) -> None:
        guards.tell("measure", message("nav_msgs/Odometry", twist__twist__linear__x=speed), at)

    for at in range(100, 1000, 50):
        guards.tell("by", seen(at), at)
        measured(0, at)
        guards.drive(twist(0.5 if at > 500 else 0), at)
    assert guards.got[-1] == (950, twist(0.5))
    for at in range(1000, 4000, 50):
        measured(1, at)
    return sum(at > 2500 for at, _data in guards.got) < 10


def passes_a_part(ordered: bool) -> bool:
    guards = together("sane", "separation", ordered=ordered)
    guards.tell("by", seen(1.0), 1)
    return guards.drive(twist(math.inf, 0, 0, 0, 0, 0.5), 2)[5] > 0


def leaves_the_fence(ordered: bool) -> bool:
    """Forward passes, backward is dropped: the base drives forward."""
    guards = together(
        "rate", "fence", ordered=ordered, rate={"interval": 1, "burst": 1}, fence={"silent": 10}
    )
    for at in range(100, 1000, 50):
        guards.tell("by", _pose(1.0), at)
    assert guards.drive(twist(0.2), 1000) == twist_legs(0.2)
    for at in (1010, 1060, 1110, 1160):
        guards.tell("by", _pose(1.0), at)
        assert guards.drive(twist(-0.2), at) == ()
    guards.got.clear()
    guards.tell("by", _pose(1.85), 1200)
    guards.advance(1250)
    return not guards.got


def stops_a_node_that_commands(ordered: bool) -> bool:
    guards = together(
        "deadman", "rate", ordered=ordered, deadman={"resume": 0}, rate={"interval": 2, "burst": 1}
    )
    guards.drive(twist(0.5), 100)
    guards.got.clear()
    for at in range(200, 1500, 100):
        guards.drive(twist(0.5), at)
    return any(data == twist(0) for _at, data in guards.got)


def ignores_a_command_that_is_not_a_number(ordered: bool) -> bool:
    guards = together("sane", "rate", ordered=ordered, rate={"interval": 1, "burst": 1})
    assert guards.drive(twist(0.5), 1000) == twist_legs(0.5)
    return guards.drive(twist(math.nan), 1100) == ()


def cancels_a_dropped_goal(ordered: bool) -> bool:
    guards = together("estop", "answer", {"command": GOAL}, ordered=ordered, answer={"limit": "1s"})
    guards.tell("stop", button(True), 1)
    assert guards.tell("command", with_id("a", 24, 72), 10).result == "dropped"
    guards.advance(3000)
    return "a" in {fields("actionlib_msgs/GoalID", data).id for _at, data in guards.got}


def moves_after_a_reset_without_a_zero(ordered: bool) -> bool:
    """An autopilot begins after the reset: the deadman stops its first commands, until they have come for a while."""
    guards = together("estop", "deadman", ordered=ordered, estop={"silent": 0})
    for at, topic, pressed in (
        (1, "stop", False), (100, "stop", True), (200, "stop", False), (300, "reset", False), (500, "reset", True),
    ):  # fmt: skip
        guards.tell(topic, button(pressed), at)
    return any(guards.drive(twist(0.5), at)[0] > 0 for at in range(600, 2000, 50))


def moves_after_the_zone_without_a_zero(ordered: bool) -> bool:
    """Only the sensor is blind at first, since it needs more valid values than the zone."""
    guards = together("zone", "sensor", ordered=ordered, sensor={"least": 1})
    moved = False
    for at in range(100, 3000, 50):
        guards.tell("by", seen(at) if at > 1500 else seen(at, blind=1), at)
        moved = moved or guards.drive(twist(0.5), at)[0] > 0
    return moved


def _pose(x: float) -> bytes:
    return message("nav_msgs/Odometry", pose__pose__position__x=x, pose__pose__orientation__w=1.0)


def twist_legs(x: float) -> tuple[float, ...]:
    return (x, 0, 0, 0, 0, 0)


CONSEQUENCES: list[Callable[[bool], bool]] = [
    jumps,
    misses_a_base_that_moves,
    passes_a_part,
    leaves_the_fence,
    stops_a_node_that_commands,
    ignores_a_command_that_is_not_a_number,
    cancels_a_dropped_goal,
]


@pytest.mark.parametrize("happens", CONSEQUENCES, ids=[consequence.__name__ for consequence in CONSEQUENCES])
def test_the_wrong_order_has_its_consequence_and_phases_prevent_it(happens: Callable[[bool], bool]) -> None:
    assert happens(False)
    assert not happens(True)


@pytest.mark.parametrize(
    "moves",
    [moves_after_a_reset_without_a_zero, moves_after_the_zone_without_a_zero],
    ids=lambda one: one.__name__,
)
def test_a_stop_by_another_guard_is_never_a_zero_of_the_node(moves: Callable[[bool], bool]) -> None:
    assert not moves(False) and not moves(True)


def test_each_row_of_the_table_has_its_test_and_the_phases_keep_it() -> None:
    assert len(PRECEDENCES) == len(CONSEQUENCES)
    for written in ([*PRESETS], [*reversed(PRESETS)]):
        texts = {f"{name}.rv": PRESETS[name].text for name in written}
        compiled = compiled_from(texts, DEFINITIONS, lints=False, without_code=texts)
        places = {specification.name: place for place, specification in enumerate(compiled.specifications)}
        for first, then in (pair for row in PRECEDENCES for pair in product(row.first, row.then)):
            assert places[first] < places[then]
