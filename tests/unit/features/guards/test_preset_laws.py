"""The laws of a safe stop, on every field that a preset observes, in every state of it.

The cells follow from `PRESETS`, the rows of message types and the patterns of the events. So a new preset needs a
recipe, and each cell that its law does not cover needs a reason in `REASONS`.
"""

import functools
import math
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from itertools import product
from typing import Any

import pytest

from appliance.features.guards.presets import PRESETS, Guard, text_of
from appliance.features.guards.robot_graph import GOAL, VELOCITIES
from rosmop.run.outcomes import MessageSender, Outcome
from rosmop.tests.acting import fields, message
from rosmop.text import tree
from rosmop.text.parser import parse, roles
from rosmop.types.roles import ANY_TYPE
from tests.support.examples import ALL
from tests.support.rows import require_rows
from tests.unit.features.guards.guarding import BEGIN, MS, NODES, Guarded
from tests.unit.features.guards.test_watching_presets import trajectory, with_id

STATES = (
    "absent", "NaN", "out of range", "unreadable", "old", "another node", "another host", "after a reset",
    "after a hold", "default",
)  # fmt: skip
Values = Mapping[str, Any]
TRAJECTORY = "trajectory_msgs/JointTrajectory"


def scan(k: int) -> Values:
    limits = {"range_min": 0.1, "range_max": 30.0}
    return {"angle_min": -math.pi, "angle_increment": math.pi / 36, **limits, "ranges": [9.0 + k * 1e-3] * 72}


def odometry(k: int) -> Values:
    return {"pose__pose__position__x": k * 1e-4, "pose__pose__orientation__w": 1.0}


EVIDENCE: dict[str, Callable[[int], Values]] = {
    "sensor_msgs/LaserScan": scan,
    "sensor_msgs/Range": lambda k: {"range": 1.0 + k * 1e-3, "min_range": 0.1, "max_range": 5.0},
    "sensor_msgs/NavSatFix": lambda k: {"latitude": k * 1e-9, "longitude": 0.0, "altitude": 1.0},
    "sensor_msgs/Imu": lambda k: {"angular_velocity__x": k * 1e-3},
    "nav_msgs/Odometry": odometry,
    "geometry_msgs/PoseStamped": lambda _k: {"pose__orientation__w": 1.0},
    "geometry_msgs/PoseWithCovarianceStamped": lambda _k: {"pose__pose__orientation__w": 1.0},
    "geometry_msgs/TwistStamped": lambda _k: {},
    "geometry_msgs/TwistWithCovarianceStamped": lambda _k: {},
    "sensor_msgs/JointState": lambda k: {"name": ["elbow"], "position": [k * 1e-4], "velocity": [0.0]},
    "sensor_msgs/BatteryState": lambda _k: {"percentage": 0.9},
    "sensor_msgs/Joy": lambda _k: {},
    "std_msgs/Bool": lambda _k: {"data": False},
    "diagnostic_msgs/DiagnosticArray": lambda _k: {"status": [{"name": "motor"}]},
}
"""Good evidence by type; `k` counts the messages."""


@dataclass(frozen=True)
class Recipe:
    """The needs of a preset beside its defaults, to let an honest robot move."""

    values: Values = field(default_factory=dict)
    fixed: Mapping[str, str] = field(default_factory=dict)
    """The types of topics that have only one."""
    by_type: Mapping[str, Values] = field(default_factory=dict)
    """Further values for a type of a topic."""
    evidence: Mapping[str, Values] = field(default_factory=dict)
    """Evidence that differs from that of the type, by topic."""
    typed: Mapping[str, Values] = field(default_factory=dict)
    """Evidence that differs from that of the type, by type."""
    first: Mapping[str, Values] = field(default_factory=dict)
    """A message that comes once before the evidence, by type."""
    velocities: str = "pass"
    """The result of a velocity that is not a finite number: `stopped`, `bounded` or `pass`, as a motion."""


RECIPES = {
    "deadman": Recipe(),
    "speed": Recipe(velocities="bounded"),
    "separation": Recipe(velocities="bounded"),
    "fence": Recipe(
        {"silent": 0.5}, by_type={"sensor_msgs/NavSatFix": {"worldFrame": True}}, velocities="bounded"
    ),
    "sensor": Recipe(by_type={"sensor_msgs/LaserScan": {"least": 1}, "sensor_msgs/JointState": {"least": 1}}),
    "estop": Recipe(fixed={"stop": "std_msgs/Bool"}),
    "ready": Recipe(
        {"needFix": True, "needCheck": True, "silent": 0.5, "checked": 1},
        {"fix": "sensor_msgs/NavSatFix", "check": "std_msgs/Bool"},
        evidence={"check": {"data": True}},
    ),
    "rate": Recipe(),
    "agree": Recipe(),
    "sane": Recipe(velocities="stopped"),
    "joints": Recipe(),
    "hold_to_run": Recipe(
        typed={"std_msgs/Bool": {"data": True}, "sensor_msgs/Joy": {"buttons": [1]}},
        first={"std_msgs/Bool": {"data": False}, "sensor_msgs/Joy": {"buttons": [0]}},
    ),
    "mode": Recipe({"vMax": 0, "wMax": 0}, velocities="bounded"),
    "overspeed": Recipe(),
    "standstill": Recipe(),
    "diagnostics": Recipe({"silent": 0.5}),
    "zone": Recipe({"clear": 0}, {"mute": "std_msgs/Bool"}),
}

APART = {
    "answer": "it follows ids of goals, not values: `test_a_goal_without_a_result_is_cancelled`",
    "withhold": "it commands no motion: `test_a_topic_is_withheld_until_all_switches_are_off_and_speak`",
}
"""Presets that no motion passes or not, each with the test that has its states."""

REASONS: dict[tuple[str, str, str, str], str] = {
    ("*", "*", "*", "another host"): "a node's name is unique at a master, so another host is another node: same cell",
    ("deadman", "command", "*", "another node"): "`watchdog` of `oracles.py`",
    ("*", "command", "*", "another node"): "a command counts for what it says, whichever node sends it",
    ("deadman", "command", "*", "old"): "`watchdog` of `oracles.py`",
    ("*", "command", "*", "old"): "the age of commands is the law of `deadman`",
    ("*", "command", "*", "absent"): "without a command a base does not move",
    ("*", "command", "", "unreadable"): "the base cannot read it either: the motion in force stays, with its evidence",
    ("*", "*", "", "NaN"): "only the arrival of a message counts, whatever it says",
    ("*", "*", "", "out of range"): "only the arrival of a message counts, whatever it says",
    ("separation", "command", "rz", "NaN"): "a turn is judged by the way that it bends, and finite by `sane`",
    ("separation", "command", "rz", "out of range"): "as NaN",
    ("fence", "command", "rz", "NaN"): "as `separation`",
    ("fence", "command", "rz", "out of range"): "as `separation`",
    ("separation", "command", "steer", "*"): "as its turn",
    ("fence", "command", "steer", "*"): "as its turn",
    ("separation", "by", "most", "out of range"): "a greater range is no danger: the readings are within it",
    ("sensor", "by", "high", "out of range"): "as `separation`",
    ("sensor", "by", "*", "out of range"): "these types declare no range: a wrong value that changes is not noticed",
    ("joints", "command", "*", "NaN"): "`test_a_trajectory_keeps_the_limits_of_its_joints`",
    ("joints", "command", "*", "out of range"): "`test_a_trajectory_keeps_the_limits_of_its_joints`",
    ("joints", "state", "names", "*"):
        "a name is found or not: `test_a_trajectory_needs_the_present_position_of_each_joint`",
    ("joints", "state", "moving", "NaN"): "each velocity up to the limit is assumed then",
    ("joints", "state", "moving", "out of range"): "each velocity up to the limit is assumed then",
    ("joints", "state", "stamp", "NaN"): "a time has no NaN",
    ("joints", "state", "stamp", "out of range"): "`test_a_stamp_is_of_the_clock_of_the_nodes_that_report`",
    ("*", "*", "pressed", "NaN"): "a truth value has no NaN",
    ("*", "*", "done", "NaN"): "a truth value has no NaN",
    ("*", "*", "held", "NaN"): "a truth value has no NaN",
    ("*", "*", "byHand", "NaN"): "a truth value has no NaN",
    ("hold_to_run", "by", "buttons", "NaN"): "a whole number has no NaN",
    ("hold_to_run", "by", "buttons", "out of range"): "`test_a_button_of_a_joystick_is_a_device`",
    ("zone", "by", "most", "out of range"): "as `separation`",
    ("zone", "mute", "*", "*"):
        "muting is off by default: `test_muting_is_off_by_default_bounded_and_needs_a_signal_that_changes`",
    ("diagnostics", "by", "statuses", "*"):
        "`test_an_entry_that_is_bad_silent_or_missing_stops_the_base_until_a_zero` has the levels and names",
    ("*", "*", "status", "NaN"): "a whole number has no NaN",
    ("sensor", "by", "altitude", "NaN"): "an altitude is not known without a fix in three dimensions",
    ("*", "*", "fixed", "NaN"): "a whole number has no NaN",
    ("estop", "reset", "*", "absent"): "without a reset the stop stays",
    ("estop", "reset", "*", "out of range"): "every number but 0 is true",
    ("estop", "reset", "*", "old"): "a reset is an act, not a state; what it frees waits for a zero",
    ("estop", "reset", "*", "unreadable"): "what is no message resets nothing: the guard holds",
    ("estop", "reset", "*", "another node"): "`two_hands` of `oracles.py`",
    ("estop", "reset", "*", "after a reset"): "`stop_button` of `oracles.py`",
}  # fmt: skip
"""Why a cell is not judged here. `*` stands for any; the first key that fits counts."""


def fits(key: Sequence[str], cell: Sequence[str]) -> bool:
    return all(wanted in {"*", given} for wanted, given in zip(key, cell, strict=True))


def reason(*cell: str) -> str:
    return next((why for key, why in REASONS.items() if fits(key, cell)), "")


@dataclass(frozen=True)
class Place:
    """A field that a preset observes on a topic of some type."""

    preset: str
    topic: str
    kind: str
    name: str
    """The parameter, or empty for a topic of which only the arrival counts."""
    path: str = ""


def paths_of(pattern: tuple[tree.Binding, ...]) -> list[tuple[str, str]]:
    """Return the path and the name of each value."""
    return [(".".join(step.name for step in one.path), one.variable or "") for one in pattern]


PATHS = {row.type: {name: path for path, name in paths_of(row.pattern)} for row in roles()["Velocity"].rows}
"""The path of each value in the types of velocities."""


def kinds_of(preset: str) -> Iterator[dict[str, str]]:
    """Yield types for the topics of a preset, so that each row of each topic is in one."""
    rows = {topic: [*rows] for topic, rows in PRESETS[preset].topics.items()}
    first = {topic: kinds[0] for topic, kinds in rows.items()}
    for topic, kinds in rows.items():
        for kind in kinds:
            yield first | {topic: "std_msgs/Bool" if kind == ANY_TYPE else kind}


@functools.cache
def places_of(preset: str) -> list[Place]:
    found: dict[Place, None] = {}
    for kinds in kinds_of(preset):
        [guard] = parse(text_of(Guard("guard", PRESETS[preset], types=kinds)), "guard.rv").specifications
        for event in guard.events:
            if isinstance(on := event.trigger, tree.MessageTrigger):
                for path, name in paths_of(on.pattern) or [("", "")]:
                    found[Place(preset, on.topic, on.type, name, path)] = None
    bound = {(one.topic, one.kind) for one in found if one.name}
    return [one for one in found if one.name or (one.topic, one.kind) not in bound]


class Lab(Guarded):
    """A guard among honest nodes: `/a` has the evidence, and commands. `before` are the texts of monitors before it."""

    def __init__(self, preset: str, place: Place | None = None, *, before: Sequence[str] = ()) -> None:
        recipe = RECIPES[preset]
        first = {topic: next(iter(rows)) for topic, rows in PRESETS[preset].topics.items()}
        self.kinds = first | dict(recipe.fixed)
        if place is not None:
            self.kinds[place.topic] = place.kind
        values = dict(recipe.values)
        for kind in self.kinds.values():
            values |= recipe.by_type.get(kind, {})
        rows = {topic: kind for topic, kind in self.kinds.items() if topic in PRESETS[preset].topics}
        super().__init__(preset, rows, before=before, **values)
        self.preset, self.at, self.count = preset, 0, 0
        self.monitors.name_senders(lambda source: (f"10.0.0.{source}", NODES[source]))
        for given, kind in self.kinds.items():
            if kind in recipe.first:
                self.send(given, recipe.first[kind])

    def send(
        self, given: str, change: Values | None = None, node: str = "/a", data: bytes | None = None
    ) -> None:
        self.count += 1
        kind = self.kinds[given]
        if data is None:
            recipe = RECIPES[self.preset]
            differs = {**recipe.typed.get(kind, {}), **recipe.evidence.get(given, {}), **(change or {})}
            data = message(kind, **{**EVIDENCE[kind](self.count), **differs})
        outcome = self.monitors.judge(
            self.topics[given], bytearray(data), BEGIN + self.at * MS, MessageSender(NODES.index(node))
        )
        self.receive(outcome, self.at)

    def command(self, change: Values | None = None, *, moves: bool = True) -> bytes:
        kind = self.kinds["command"]
        if kind in VELOCITIES:
            x = PATHS[kind]["x"].replace(".", "__")
            return message(kind, **{x: 0.1 if moves else 0.0, **(change or {})})
        if kind == TRAJECTORY:
            return trajectory(["elbow"], (1.0, [0.0]), (2.0, [0.01]))
        if self.preset == "joints":
            return with_id("a", 24, 0) + trajectory(["elbow"], (1.0, [0.0])) + bytes(16)
        return with_id("a", 24, 40 if kind == GOAL else 72)

    def moved(self, data: bytes) -> bool:
        """Return whether a command moves something."""
        kind = self.kinds["command"]
        if kind in VELOCITIES:
            read = fields(kind, data)
            return any(_get(read, path) != 0 for name, path in PATHS[kind].items() if name in MOVING)
        return kind != TRAJECTORY or len(fields(kind, data).points) > 0

    def judged(self, data: bytes) -> Outcome:
        """Let `/a` send a command."""
        return self.monitors.judge(
            self.topics["command"], bytearray(data), BEGIN + self.at * MS, MessageSender(1)
        )

    def passes(self, change: Values | None = None, *, moves: bool = True) -> bool:
        outcome = self.judged(self.command(change, moves=moves))
        self.receive(outcome, self.at)
        return outcome.result != "dropped" and self.moved(bytes(outcome.buffer))

    def step(self, ms: int = 50) -> None:
        self.at += ms
        self.advance(self.at)

    def run(
        self,
        ms: int,
        *,
        without: str = "",
        bad: Callable[[], None] | None = None,
        drives: bool = True,
        stands: bool = False,
    ) -> bool:
        """Let good evidence come every 50 ms, except on a topic; return whether the last command passed."""
        passed = False
        for step in range(ms // 50):
            self.step()
            for given in self.kinds:
                if given not in {"command", without}:
                    self.send(given)
            if bad is not None:
                bad()
            if drives:
                passed = self.passes(moves=not stands and (self.at > 400 or step > 8))
        return passed

    def own_motions(self) -> int:
        """Return the number of messages by the guard itself that move something."""
        return sum(self.moved(data) for _at, data in self.got) if self.kinds["command"] in VELOCITIES else 0


MOVING = {"x", "y", "z", "rx", "ry", "rz"}


def _get(read: Any, path: str) -> float:
    for part in path.split("."):
        read = getattr(read, part)
    return float(read)


DOUBLES = {
    "sensor_msgs/NavSatFix", "sensor_msgs/Imu", "sensor_msgs/JointState", "nav_msgs/Odometry", "geometry_msgs/Twist",
    "geometry_msgs/PoseStamped", "geometry_msgs/PoseWithCovarianceStamped", "geometry_msgs/TwistStamped",
    "geometry_msgs/TwistWithCovarianceStamped",
}  # fmt: skip
"""Types whose numbers are doubles; those of all others are floats, which have no 1e200, but 3e38."""


def changed(place: Place, value: Any, good: Values) -> Values | None:
    """Return the changes that set a field, or nothing if it cannot have the value."""
    key = place.path.replace(".", "__")
    if place.name == "q":
        return {f"{key}__{axis}": value for axis in "xyzw"}
    if place.kind not in DOUBLES and abs(value) > 3e38:
        value = math.copysign(3e38, value)
    if isinstance(good.get(key), list):
        return None if isinstance(good[key][0], str) else {key: [value] * len(good[key])}
    return {key: value}


def judge(place: Place, state: str) -> str:
    """Return what is wrong with a cell, or an empty text."""
    lab = Lab(place.preset, place)
    if state == "default":
        return "" if lab.run(1500) else "an honest robot does not move"
    return CELLS[state](lab, place)


def _absent(lab: Lab, place: Place) -> str:
    return "a motion passes without it" if lab.run(1500, without=place.topic) else ""


def _wrong(value: float, whole: int) -> Callable[[Lab, Place], str]:
    def cell(lab: Lab, place: Place) -> str:
        assert lab.run(1500), "an honest robot does not move"
        if place.topic == "command":
            return _wrong_command(lab, place, value)
        good = EVIDENCE[place.kind](1)
        is_bool = place.kind == "std_msgs/Bool"
        is_whole = place.path.startswith("status.")
        assert not (math.isnan(value) and (is_bool or is_whole)), "give a reason"
        change = changed(place, True if is_bool else whole if is_whole else value, good)
        assert change is not None, "give a reason"
        if place.preset in {"ready", "hold_to_run"} and is_bool:
            change = {"data": False}
        passed = lab.run(1000, without=place.topic, bad=lambda: lab.send(place.topic, change))
        return "a motion passes with it" if passed else ""

    return cell


def _wrong_command(lab: Lab, place: Place, value: float) -> str:
    value = value if place.kind in DOUBLES or not abs(value) > 3e38 else 3e38
    change = {place.path.replace(".", "__"): value}
    how = RECIPES[place.preset].velocities
    outcome = lab.judged(lab.command(change))
    got = _get(fields(place.kind, bytes(outcome.buffer)), place.path)
    is_finite = math.isfinite(_get(fields(place.kind, lab.command(change)), place.path))
    if how == "stopped":
        return "" if lab.moved(bytes(outcome.buffer)) == is_finite else "it is not stopped"
    if how == "bounded":
        return "" if abs(got) <= 1000 or (is_finite and place.preset != "speed") else f"{got} passes"
    return "" if math.isclose(got, value, rel_tol=1e-6) or not is_finite else "it is changed"


def _unreadable(lab: Lab, place: Place) -> str:
    assert lab.run(1500), "an honest robot does not move"
    lab.got.clear()
    if place.topic == "command":
        data = lab.command()[:3]
        outcome = lab.judged(data)
        return "it passes" if outcome.result != "dropped" and bytes(outcome.buffer) == data else ""
    passed = lab.run(600, without=place.topic, bad=lambda: lab.send(place.topic, data=b""))
    return "a motion passes" if passed else ""


def _old(lab: Lab, place: Place) -> str:
    assert lab.run(1500), "an honest robot does not move"
    lab.got.clear()
    lab.run(1500, without=place.topic, drives=False)
    if place.preset != "joints" and not any(not lab.moved(data) for _at, data in lab.got):
        return "the guard sends no stop"
    return "a motion passes" if lab.passes() else ""


def _another_node(lab: Lab, place: Place) -> str:
    assert lab.run(1500), "an honest robot does not move"
    passed = lab.run(2500, without=place.topic, bad=lambda: lab.send(place.topic, node="/b"))
    return "another node hides that the first is silent" if passed else ""


def _after_a_reset(lab: Lab, place: Place) -> str:
    """After its evidence was missing, or a stop, nothing moves without a new command."""
    assert lab.run(1500), "an honest robot does not move"
    without = "" if place.topic == "command" else place.topic
    lab.run(1500, without=without, drives=False)
    lab.got.clear()
    lab.run(1500, drives=False)
    return "the guard moves the base" if lab.own_motions() else ""


ZERO_FIRST = {name for name, preset in PRESETS.items() if "zeroFirst" in preset.text}


def _after_a_hold(lab: Lab, place: Place) -> str:
    assert lab.run(1500), "an honest robot does not move"
    lab.monitors.hold(lab.monitors.monitor("guard"), "an operator asks for it")
    lab.got.clear()
    if lab.run(500):
        return "a motion passes while the guard holds"
    lab.monitors.resume("guard")
    lab.run(500, drives=False)
    if lab.own_motions():
        return "the guard moves the base"
    if lab.preset in ZERO_FIRST and lab.kinds["command"] in VELOCITIES and lab.run(500):
        return "a node moves the base that has not commanded zero since the hold"
    lab.run(500, stands=True)
    lab.run(1000)
    return "" if lab.run(1500) else "an honest robot does not move afterwards"


CELLS = {
    "absent": _absent, "NaN": _wrong(math.nan, 0), "out of range": _wrong(1e200, 99), "unreadable": _unreadable,
    "old": _old, "another node": _another_node, "after a reset": _after_a_reset, "after a hold": _after_a_hold,
}  # fmt: skip


@pytest.mark.parametrize("preset", RECIPES)
def test_each_state_of_each_observed_field_keeps_the_laws(preset: str) -> None:
    wrong = []
    for number, (place, state) in enumerate(product(places_of(preset), STATES), [*RECIPES].index(preset)):
        # At the gate every 15th cell, so that the states rotate over the fields; at night every cell.
        if (
            (ALL or number % 15 == 0)
            and not reason(preset, place.topic, place.name, state)
            and (why := judge(place, state))
        ):
            wrong.append(f"{preset}, {place.topic} {place.kind} {place.path or 'arrival'}, {state}: {why}")
    assert not wrong, "\n".join(wrong)


@pytest.mark.complete
def test_every_preset_has_a_recipe_or_a_test_of_its_own() -> None:
    require_rows(PRESETS, RECIPES.keys() | APART.keys(), "RECIPES here, or to APART with its own test")
    assert not RECIPES.keys() & APART.keys()


def test_each_reason_has_a_cell() -> None:
    places = [place for preset in RECIPES for place in places_of(preset)]
    for *cell, state in REASONS:
        there = ((place.preset, place.topic, place.name) for place in places)
        assert state in {"*", *STATES} and any(fits(cell, one) for one in there), f"no cell has {cell}"
