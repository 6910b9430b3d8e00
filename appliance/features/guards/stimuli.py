"""Make the messages that test a guard: first those of an honest robot, then those of one fault.

They go to a copy of the guard (`relay/monitors/guard_trial.py`), never to a robot. Before the fault, sensors and
buttons are well, the commanding node stands, and then it commands a slow motion, which must pass. From the fault on,
the copy must stop, limit, drop or withhold.
"""

import math
import struct
from collections.abc import Callable, Iterator, Mapping
from typing import Any, NamedTuple

from appliance.base.counted import counted
from appliance.channel.messages import SyntheticMessage
from appliance.features.guards.presets import GuardError
from rosmop.types import given_lists
from roswire.definitions import Definitions
from roswire.errors import DefinitionError
from roswire.message_text import PRIMITIVES
from roswire.standard import standard_definitions

Fields = Mapping[str, Any]
Values = Mapping[str, str]
Reading = Callable[[int], Fields | None]
"""Returns the fields of the message with a number, or None while the node is silent."""

VELOCITIES: Mapping[str, tuple[str, ...]] = {
    "geometry_msgs/Twist": ("linear", "x"),
    "geometry_msgs/TwistStamped": ("twist", "linear", "x"),
    "ackermann_msgs/AckermannDrive": ("speed",),
    "ackermann_msgs/AckermannDriveStamped": ("drive", "speed"),
}
"""The types of velocities, with the place of the linear one."""
_STAND_SECONDS, _DRIVE_SECONDS, _PERIOD = 0.5, 1.0, 0.05
_MAX = 4000  # messages of a test
_METRES = 111_195.0  # of a degree of latitude
_FAR, _NEAR = 20.0, 0.12
_DRIVER, _ROBOT = "/test_driver", "/test_robot"


class Stimulus(NamedTuple):
    """A test: `what` is the fault in words, with number `fault` the messages of the fault begin."""

    what: str
    messages: list[SyntheticMessage]
    fault: int


class _Fault(NamedTuple):
    """A fault: what is done from then on. `readings` replace those of before; the command becomes `drive` if given."""

    what: str
    readings: Mapping[tuple[str, str], Reading] = {}
    drive: Reading | None = None
    seconds: float = 1.0
    at_once: int = 0
    """So many commands come at once."""


def stimulus(preset: str, topics: Mapping[str, str], types: Mapping[str, str], values: Values) -> Stimulus:
    """Return the test of a guard with these topics and types by the preset's names for them, and all its values.

    Raises `GuardError` with the reason if there is none for it.
    """
    robot = _Robot(preset, topics, types, values)
    try:
        return robot.stimulus()
    except DefinitionError as error:
        raise GuardError(f"a message of {preset} cannot be made: {error}") from error


class _Robot:
    """The honest robot of a guard, and its fault."""

    def __init__(
        self, preset: str, topics: Mapping[str, str], types: Mapping[str, str], values: Values
    ) -> None:
        self._preset, self.topics, self.types, self.values = preset, topics, types, values
        self._moves = types["command"] in VELOCITIES
        self._definitions = standard_definitions()  # takes longer than all messages

    def stimulus(self) -> Stimulus:
        speed = self.speed()
        if self._preset not in _FAULTS:
            raise GuardError(f"there is no test of {self._preset}")
        readings = dict(_HONEST.get(self._preset, _unobserved)(self))
        fault = _FAULTS[self._preset](self)
        silent = self.number("silent") or 1.0
        period = min(_PERIOD, silent / 3)
        if self._preset == "rate":
            period = max(period, 1.5 * self.number("interval"))
        wait = sum(self.number(name) for name in ("resume", "clear"))
        stand, drive = (round((each + wait) / period) + 2 for each in (_STAND_SECONDS, _DRIVE_SECONDS))
        last = math.ceil(fault.seconds / period) + 2
        if (stand + drive + last + fault.at_once) * (1 + len(readings)) > _MAX:
            raise GuardError("its values need a test of too many messages: test it on the robot")
        made: list[SyntheticMessage] = []
        for number in range(stand + drive):
            fields = self.command(0.0 if number < stand else speed)
            made += self._turn(number, period, readings, fields)
        begin = len(made)
        readings |= fault.readings
        commands = fault.drive or (lambda _number: self.command(speed))
        made += [self._said("command", _DRIVER, commands(0)) for _ in range(fault.at_once)]
        for number in range(stand + drive, stand + drive + last):
            made += self._turn(number, period, readings, commands(number))
        return Stimulus(fault.what, made, begin)

    def _turn(
        self, number: int, period: float, readings: Mapping[tuple[str, str], Reading], command: Fields | None
    ) -> Iterator[SyntheticMessage]:
        yield SyntheticMessage(period)
        for (topic, node), reading in readings.items():
            if (fields := reading(number)) is not None:
                yield self._said(topic, node, fields)
        if command is not None:
            yield self._said("command", _DRIVER, command)

    def _said(self, topic: str, node: str, fields: Fields | None) -> SyntheticMessage:
        data = encode_message(self._definitions, self.types[topic], fields or {})
        return SyntheticMessage(0.0, self.topics[topic], data, node)

    def number(self, name: str) -> float:
        return float(self.values.get(name, "0"))

    def is_true(self, name: str) -> bool:
        return self.values.get(name) == "true"

    def speed(self) -> float:
        """Return the velocity of an honest motion: above what a guard that limits permits in the fault."""
        match self._preset:
            case "mode":
                return self.number("vMax") + 0.05
            case "zone":
                return self.number("slow") + 0.05
            case "speed":
                return min(0.05, self.number("vMax") / 2, self.number("aMax") / 2)
        return 0.05

    def command(self, v: float) -> Fields | None:
        kind = self.types["command"]
        if self._moves:
            return _nested(VELOCITIES[kind], v)
        match kind:
            case "trajectory_msgs/JointTrajectory":
                return self._path(0.0)
            case "control_msgs/FollowJointTrajectoryActionGoal":
                return {"goal_id": {"id": "test"}, "goal": {"trajectory": self._path(0.0)}}
            case "move_base_msgs/MoveBaseActionGoal":
                return {"goal_id": {"id": "test"}}
        return {}

    def _path(self, offset: float) -> Fields:
        names = [*self.joints()]
        point = {"positions": [place + offset for place in self.joints().values()],
                 "time_from_start": (1, 0)}  # fmt: skip
        return {"joint_names": names, "points": [point]}

    def joints(self) -> Mapping[str, float]:
        """The joints with a place in the middle of their limits."""
        rows = given_lists.joints(self.values.get("limits", given_lists.NO_JOINTS))
        found = {name: (float(low) + float(high)) / 2 for name, low, high in rows}
        return found or {"test_joint": (self.number("low") + self.number("high")) / 2}

    @property
    def several(self) -> list[str]:
        """The nodes that must have been heard: buttons, devices, or those that say the mode."""
        return [f"{_ROBOT}_{number}" for number in range(max(1, round(self.number("publishers"))))]

    def beyond(self) -> Fields:
        path = self._path(1e6)
        goal = {"goal_id": {"id": "test"}, "goal": {"trajectory": path}}
        return path if self.types["command"] == "trajectory_msgs/JointTrajectory" else goal

    def button_fields(self, *, held: bool) -> Fields:
        if self.types["by"] == "sensor_msgs/Joy":
            return {"buttons": [0] * round(self.number("button")) + [int(held)]}
        return {"data": held}

    def corners(self) -> list[tuple[float, float]]:
        return [(float(x), float(y)) for x, y in given_lists.corners(self.values["polygon"])]

    def place(self, x: float, y: float) -> Fields:
        match self.types["by"]:
            case "sensor_msgs/NavSatFix":
                lat0, lon0 = self.number("lat0"), self.number("lon0")
                east = _METRES * max(0.01, math.cos(math.radians(lat0)))
                return {"latitude": lat0 + y / _METRES, "longitude": lon0 + x / east}
            case "geometry_msgs/PoseStamped":
                return dict(_pose(x, y)["pose"])
        return _pose(x, y)

    def entries(self, level: int) -> Fields:
        rows = []
        for text, place in given_lists.entries(self.values["named"]):
            key = "hardware_id" if place in ("2", "3") else "name"
            rows.append({"level": level, "name": "a test", key: text or "a test"})
        return {"status": rows}


def _nested(names: tuple[str, ...], value: float) -> Fields:
    found: Any = value
    for name in reversed(names):
        found = {name: found}
    return dict(found)


def _scan(distance: float) -> Fields:
    rays = 360
    return {"angle_min": -math.pi, "angle_max": math.pi, "angle_increment": 2 * math.pi / rays, "range_min": 0.05,
            "range_max": 30.0, "ranges": [distance] * rays}  # fmt: skip


def _motion(kind: str, v: float) -> Fields:
    twist = {"linear": {"x": v}}
    return {"twist": twist} if kind == "geometry_msgs/TwistStamped" else {"twist": {"twist": twist}}


_SENSED: Mapping[str, Callable[[float], Fields]] = {
    "sensor_msgs/LaserScan": lambda noise: _scan(5 + noise),
    "sensor_msgs/Range": lambda noise: {"range": 1 + noise, "min_range": 0.1, "max_range": 9.0},
    "sensor_msgs/NavSatFix": lambda noise: {"latitude": 48 + noise, "longitude": 11.0},
    "sensor_msgs/Imu": lambda noise: {"linear_acceleration": {"x": noise, "z": 9.81}},
    "nav_msgs/Odometry": lambda noise: _pose(noise, 0.0),
    "sensor_msgs/JointState": lambda noise: {"name": ["joint"], "position": [noise]},
}
"""Messages of sensors whose values change; of other types, only the time of arrival counts."""


def _plain(_noise: float) -> Fields:
    return {}


def _pose(x: float, y: float) -> Fields:
    return {"pose": {"pose": {"position": {"x": x, "y": y}, "orientation": {"w": 1.0}}}}


Readings = Iterator[tuple[tuple[str, str], Reading]]
"""The messages of each node of an honest robot, by the preset's name of the topic and the node."""


def _unobserved(_robot: _Robot) -> Readings:
    return iter(())


def _said_by(topic: str, nodes: list[str], fields: Fields) -> Readings:
    for node in nodes:
        yield (topic, node), lambda _number: fields


def _sensor(robot: _Robot) -> Readings:
    sensed: Callable[[float], Fields] = _SENSED.get(robot.types["by"], _plain)
    yield ("by", _ROBOT), lambda number: sensed(0.01 * (number % 7))


def _moved(robot: _Robot) -> Readings:
    yield from _said_by("by", [_ROBOT], _motion(robot.types["by"], 0.0))
    if "other" in robot.topics:
        yield from _said_by("other", [f"{_ROBOT}_other"], _motion(robot.types["other"], 0.0))


def _buttons(robot: _Robot) -> Readings:
    yield from _said_by("stop", robot.several, {"data": False})
    for hand in range(2 if robot.is_true("twoHands") else 1):
        yield ("reset", f"{_ROBOT}_reset_{hand}"), lambda number: {"data": number % 8 >= 4}


def _devices(robot: _Robot) -> Readings:
    for node in robot.several:
        yield ("by", node), lambda number: robot.button_fields(held=number > 2)


def _armed(robot: _Robot) -> Readings:
    yield from _said_by("by", [_ROBOT], {"percentage": 100.0 if robot.is_true("hundred") else 1.0})
    if robot.is_true("needFix"):
        yield from _said_by("fix", [_ROBOT], {"latitude": 48.0, "longitude": 11.0})
    if robot.is_true("needCheck"):
        yield from _said_by("check", [_ROBOT], {"data": True})


def _reported(robot: _Robot) -> Readings:
    joints = robot.joints()
    return _said_by("state", [_ROBOT], {"name": [*joints], "position": [*joints.values()]})


_HONEST: Mapping[str, Callable[[_Robot], Readings]] = {
    "separation": lambda _robot: _said_by("by", [_ROBOT], _scan(_FAR)),
    "zone": lambda _robot: _said_by("by", [_ROBOT], _scan(_FAR)),
    "sensor": _sensor,
    "fence": lambda robot: _said_by("by", [_ROBOT], robot.place(*_inside(robot.corners()))),
    "agree": _moved,
    "overspeed": _moved,
    "standstill": _moved,
    "estop": _buttons,
    "hold_to_run": _devices,
    "mode": lambda robot: _said_by("by", robot.several, {"data": False}),
    "withhold": lambda _robot: _said_by("by", [f"{_ROBOT}_0"], {"data": False}),
    "ready": _armed,
    "joints": _reported,
    "diagnostics": lambda robot: _said_by("by", [_ROBOT], robot.entries(0)),
}


def _from(what: str, topic: str, node: str, fields: Fields | None, **more: Any) -> _Fault:
    """Return the fault of one node that says something else from then on, or nothing."""
    return _Fault(what, {(topic, node): lambda _number: fields}, **more)


def _commanded(what: str, fields: Fields | None, **more: Any) -> _Fault:
    return _Fault(what, drive=lambda _number: fields, **more)


def _near_thing(robot: _Robot) -> _Fault:
    near = robot.number("own") + _NEAR
    return _from(f"a scan with things at {near:g} m all round", "by", _ROBOT, _scan(near))


def _too_fast(robot: _Robot, name: str, what: str, **more: Any) -> _Fault:
    v = 2 * robot.number(name) + 1
    motion = _motion(robot.types["by"], v)
    return _from(f"a measured velocity of {v:g} m/s{what}", "by", _ROBOT, motion, **more)


def _outside(robot: _Robot) -> _Fault:
    x, y = (max(corner[axis] for corner in robot.corners()) + 10 for axis in (0, 1))
    return _from(f"a position outside of the polygon, at {x:g}, {y:g}", "by", _ROBOT, robot.place(x, y))


def _over_limit(robot: _Robot) -> _Fault:
    v = 2 * robot.number("vMax") + 1
    return _commanded(f"a command of {v:g} m/s", robot.command(v))


def _burst(robot: _Robot) -> _Fault:
    number = math.ceil(robot.number("burst")) + 2
    return _Fault(f"{counted(number, 'command')} at once", at_once=number)


_FIRST = f"{_ROBOT}_0"
_FAULTS: Mapping[str, Callable[[_Robot], _Fault]] = {
    "deadman": lambda robot: _commanded(
        "the commanding node falls silent in motion", None, seconds=robot.number("silent") + 0.2
    ),
    "speed": _over_limit,
    "rate": _burst,
    "sane": lambda robot: _commanded("a command that is not a number", robot.command(math.nan)),
    "separation": _near_thing,
    "zone": _near_thing,
    "sensor": lambda robot: _from(
        f"{robot.topics['by']} falls silent", "by", _ROBOT, None, seconds=robot.number("silent") + 0.2
    ),
    "fence": _outside,
    "agree": lambda robot: _too_fast(
        robot, "tolerance", f", and of 0 on {robot.topics['other']}",
        seconds=_PERIOD * robot.number("samples") + 1,
    ),
    "overspeed": lambda robot: _too_fast(robot, "vMax", ""),
    "standstill": lambda robot: _too_fast(
        robot, "still", " while zero is commanded", drive=lambda _number: robot.command(0.0),
        seconds=robot.number("settle") + 1,
    ),
    "estop": lambda robot: _from(f"a press on {robot.topics['stop']}", "stop", _FIRST, {"data": True}),
    "hold_to_run": lambda robot: _from(
        f"the device on {robot.topics['by']} is let go", "by", _FIRST, robot.button_fields(held=False)
    ),
    "mode": lambda robot: _from(
        f"manual mode on {robot.topics['by']}, and a command of {robot.speed():g} m/s", "by", _FIRST, {"data": True}
    ),
    "withhold": lambda robot: _from(f"the switch on {robot.topics['by']} is on", "by", _FIRST, {"data": True}),
    "ready": lambda _robot: _from("an empty battery", "by", _ROBOT, {"percentage": 0.0}),
    "joints": lambda robot: _commanded("a trajectory beyond the limits", robot.beyond()),
    "diagnostics": lambda robot: _from("the entries at ERROR", "by", _ROBOT, robot.entries(2)),
    "answer": lambda robot: _commanded(
        "a goal without a result", None, seconds=given_lists.nanoseconds(robot.values["limit"]) / 1e9
    ),
}  # fmt: skip
"""The fault of each preset."""


def _inside(corners: list[tuple[float, float]]) -> tuple[float, float]:
    """Return a point inside of the polygon that is far from its edges."""
    xs, ys = [[corner[axis] for corner in corners] for axis in (0, 1)]
    grid = [
        (min(xs) + (max(xs) - min(xs)) * a / 40, min(ys) + (max(ys) - min(ys)) * b / 40)
        for a in range(1, 40) for b in range(1, 40)
    ]  # fmt: skip
    edges = [*zip(corners, [*corners[1:], corners[0]], strict=True)]

    def room(x: float, y: float) -> float:
        crossings = [
            a for a, b in edges if (a[1] > y) != (b[1] > y) and x < a[0] + (y - a[1]) * (b[0] - a[0]) / (b[1] - a[1])
        ]  # fmt: skip
        return min(_distance(x, y, *edge) for edge in edges) if len(crossings) % 2 else -1.0

    return max(grid, key=lambda point: room(*point))


def _distance(x: float, y: float, a: tuple[float, float], b: tuple[float, float]) -> float:
    long = (b[0] - a[0]) ** 2 + (b[1] - a[1]) ** 2
    along = ((x - a[0]) * (b[0] - a[0]) + (y - a[1]) * (b[1] - a[1])) / long if long else 0.0
    along = min(1.0, max(0.0, along))
    return math.hypot(x - a[0] - along * (b[0] - a[0]), y - a[1] - along * (b[1] - a[1]))


def encode_message(definitions: Definitions, kind: str, fields: Fields) -> bytes:
    """Return a serialized message with these fields; all others are zero or empty.

    Raises `DefinitionError` for an unknown type.
    """
    data = bytearray()
    for field in definitions.message(kind).fields:
        value = fields.get(field.name)
        if not field.is_array:
            data += _value(definitions, field.type, value)
            continue
        items = [None] * (field.length or 0) if value is None else value
        if field.length is None:
            data += struct.pack("<I", len(items))
        if field.type in PRIMITIVES and value is not None and field.type not in ("time", "duration"):
            data += struct.pack(f"<{len(items)}{PRIMITIVES[field.type][0]}", *items)
            continue
        for item in items:
            data += _value(definitions, field.type, item)
    return bytes(data)


def _value(definitions: Definitions, kind: str, value: Any) -> bytes:
    if kind == "string":
        text = str(value or "").encode()
        return struct.pack("<I", len(text)) + text
    if kind in ("time", "duration"):
        return struct.pack("<" + PRIMITIVES[kind][0], *(value or (0, 0)))
    if kind in PRIMITIVES:
        return struct.pack("<" + PRIMITIVES[kind][0], value or 0)
    return encode_message(definitions, kind, value or {})
