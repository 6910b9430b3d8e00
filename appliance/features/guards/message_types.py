"""Adapt the text of a preset to the message types of a robot's topics.

A preset is a valid text for one type. For another type, the type and the pattern of the events are replaced. A value
that the type lacks becomes a local variable. Values that only other types have are zero in the first line of an event.
"""

import re
from collections.abc import Mapping
from dataclasses import dataclass, field

AXES = ("x", "y", "z", "rx", "ry", "rz")
_LEGS = ("linear.x", "linear.y", "linear.z", "angular.x", "angular.y", "angular.z")


@dataclass(frozen=True)
class TypeRow:
    """The path of each value in a message type."""

    paths: Mapping[str, str] = field(default_factory=dict)
    stops: bool = True
    """Whether a message can stop the robot. Otherwise a command is dropped, and all goals of its action are
    cancelled.
    """
    parameters: str = ""
    """The event's parameters if a value is made of several fields. `local` then makes the value, or makes one where the
    message gives none.
    """
    local: str = ""
    element: str = ""
    """The type of the elements of `values`, in variables that keep them, or empty for the type in the text."""


def _twist(before: str = "") -> TypeRow:
    return TypeRow({axis: before + leg for axis, leg in zip(AXES, _LEGS, strict=True)})


_UNLIMITED = "double low = -INFINITY, high = INFINITY;"


def _listed(*paths: str, low: str = "", high: str = "", may_lack: str = "") -> TypeRow:
    """Make `values` of the fields at `paths`, or none if one is not finite; the field `may_lack` may be.

    `low` and `high` are the fields of their range, if the type has them.
    """
    names = ["lacking" if path == may_lack else f"v{place}" for place, path in enumerate(paths)]
    finite = " && ".join(f"isfinite({name})" for name in names if name != "lacking")
    limits = {"low": low, "high": high} if low else {}
    return TypeRow(
        {**dict(zip(names, paths, strict=True)), **limits},
        parameters=", ".join(f"double {name}" for name in (*names, *limits)),
        local=f"std::vector<double> values = {{{', '.join(names)}}};"
        + (f"\n        if (!({finite})) {{ values.clear(); }}" if len(paths) > 1 else "")
        + ("" if limits else f"\n        {_UNLIMITED}"),
        element="double",
    )


def _ackermann(before: str = "") -> TypeRow:
    fields = {"x": "speed", "steer": "steering_angle", "steerRate": "steering_angle_velocity"}
    return TypeRow(
        {
            name: before + path
            for name, path in {**fields, "acceleration": "acceleration", "jerk": "jerk"}.items()
        }
    )


VELOCITIES = {
    "geometry_msgs/Twist": _twist(),
    "geometry_msgs/TwistStamped": _twist("twist."),
    "ackermann_msgs/AckermannDrive": _ackermann(),
    "ackermann_msgs/AckermannDriveStamped": _ackermann("drive."),
}
TRAJECTORY = {"names": "joint_names", "points": "points"}
GOAL = "control_msgs/FollowJointTrajectoryActionGoal"
TRAJECTORIES = {
    "trajectory_msgs/JointTrajectory": TypeRow(TRAJECTORY),
    GOAL: TypeRow({name: f"goal.trajectory.{path}" for name, path in TRAJECTORY.items()}, stops=False),
}
GOALS = {
    "move_base_msgs/MoveBaseActionGoal": TypeRow({"id": "goal_id.id"}, stops=False),
    GOAL: TypeRow({"id": "goal_id.id"}, stops=False),
}
COMMANDS = VELOCITIES | TRAJECTORIES | {"move_base_msgs/MoveBaseActionGoal": TypeRow(stops=False)}
RESULTS = {goal.replace("ActionGoal", "ActionResult"): TypeRow({"id": "status.goal_id.id"}) for goal in GOALS}


def _pose(before: str) -> TypeRow:
    return TypeRow({"px": f"{before}position.x", "py": f"{before}position.y", "q": f"{before}orientation"})


_FIX = TypeRow(
    {"fixed": "status.status", "lat": "latitude", "lon": "longitude"},
    parameters="int fixed, double lat, double lon",
    local="""bool known = fixed >= 0 && fixed <= 2;
        double px = known ? metres_east(lat, lon, lat0, lon0) : NAN;
        double py = known ? metres_north(lat, lon, lat0, lon0) : NAN;
        geometry_msgs::Quaternion q;
        q.w = NAN;                                             // a fix has no direction""",
)
POSES = {
    "nav_msgs/Odometry": _pose("pose.pose."),
    "geometry_msgs/PoseStamped": _pose("pose."),
    "geometry_msgs/PoseWithCovarianceStamped": _pose("pose.pose."),
}
POSITIONS = POSES | {"sensor_msgs/NavSatFix": _FIX}
_TURNS = {"vx": "linear.x", "vy": "linear.y", "vz": "linear.z", "turn": "angular.z",
          "wx": "angular.x", "wy": "angular.y", "wz": "angular.z"}  # fmt: skip
MOTIONS = {
    kind: TypeRow({name: before + path for name, path in _TURNS.items()})
    for kind, before in (
        ("nav_msgs/Odometry", "twist.twist."),
        ("geometry_msgs/TwistStamped", "twist."),
        ("geometry_msgs/TwistWithCovarianceStamped", "twist.twist."),
    )
}
_ARRIVAL = TypeRow(
    local="std::vector<double> values = {ros::Time::now().toSec()};       // only its silence is judged\n"
    f"        {_UNLIMITED}",
    element="double",
)
ANY_TYPE = "*"
"""The key of the row for every type that has none of its own."""
SENSORS = {
    "sensor_msgs/LaserScan": TypeRow({"values": "ranges", "low": "range_min", "high": "range_max"}),
    "sensor_msgs/Range": _listed("range", low="min_range", high="max_range"),
    "sensor_msgs/NavSatFix": _listed("latitude", "longitude", "altitude", may_lack="altitude"),
    "sensor_msgs/Imu": _listed(
        *(f"{what}.{axis}" for what in ("angular_velocity", "linear_acceleration") for axis in "xyz")
    ),
    "nav_msgs/Odometry": _listed(
        *(f"pose.pose.position.{axis}" for axis in "xyz"),
        *(f"pose.pose.orientation.{axis}" for axis in "xyzw"),
    ),
    "sensor_msgs/JointState": TypeRow(
        {"values": "position"}, parameters="double[] values", local=_UNLIMITED, element="double"
    ),
    "sensor_msgs/Joy": _ARRIVAL,
    ANY_TYPE: _ARRIVAL,
}
_SCAN = {
    "first": "angle_min", "increment": "angle_increment", "least": "range_min", "most": "range_max", "ranges": "ranges",
}  # fmt: skip
SCANS = {"sensor_msgs/LaserScan": TypeRow(_SCAN)}
JOINTS = {"sensor_msgs/JointState": TypeRow({"names": "name", "found": "position"})}
BATTERIES = {"sensor_msgs/BatteryState": TypeRow({"percentage": "percentage"})}

ENABLERS = {
    "std_msgs/Bool": TypeRow({"held": "data"}),
    "sensor_msgs/Joy": TypeRow(
        {"buttons": "buttons"},
        parameters="int[] buttons",
        local="bool held = button < buttons.size() && buttons[button] == 1;",
    ),
}
MODES = {"std_msgs/Bool": TypeRow({"byHand": "data"})}
SWITCHES = {"std_msgs/Bool": TypeRow({"withheld": "data"})}
PRIVATE = {
    kind: TypeRow()
    for kind in (
        "sensor_msgs/Image", "sensor_msgs/CompressedImage", "sensor_msgs/PointCloud2", "sensor_msgs/LaserScan",
        "sensor_msgs/NavSatFix", "sensor_msgs/JointState", "nav_msgs/Odometry", "nav_msgs/OccupancyGrid",
        "geometry_msgs/PoseStamped", "geometry_msgs/PoseWithCovarianceStamped", "tf2_msgs/TFMessage",
        "std_msgs/String",
    )
}  # fmt: skip

_EVENT = re.compile(
    r"event (?P<name>\w+)\((?P<parameters>[^)]*)\) (?P<topic>\w+)\s+(?P<type>\w+/\w+)\s+'\{(?P<pattern>[^}]*)\}'"
    r"(?P<when>\s++when \([^{]*\))? \{(?:\n +double (?P<zeros>\w++ = 0(?:, \w++ = 0)*+);[^\n]*+)?"
)
_SAFE = re.compile(r"safe (?P<type>\w+/\w+) \{ \} on command every 100ms;")
_COMMAND = re.compile(r"topic command = ([^;]+);")
_STOP = re.compile(r"\bSTOP;")
_KEPT = re.compile(r"std::vector<float> ")
_WIDTH = 110


def text_for(text: str, topic: str, kind: str, row: TypeRow) -> str:
    for found in reversed([*_EVENT.finditer(text)]):
        if found["topic"] == topic:
            header = _header(found, kind, row)
            end = _end_of(text, found.end())
            body = text[found.end() : end]
            if topic == "command" and not row.stops:
                body = _STOP.sub("DROP;", body)
            text = text[: found.start()] + header + body + text[end:]
    if row.element:
        text = _KEPT.sub(f"std::vector<{row.element}> ", text)
    if topic != "command" or not _SAFE.search(text):
        return text
    return _SAFE.sub(f"safe {kind} {{ }} on command every 100ms;", text) if row.stops else _cancelling(text)


def row_of(rows: Mapping[str, TypeRow], kind: str) -> TypeRow | None:
    """Return the row of a type, or of every type, or nothing if none fits."""
    return rows.get(kind) or rows.get(ANY_TYPE)


def works_with(rows: Mapping[str, TypeRow]) -> str:
    return ", ".join("any other type by its silence alone" if kind == ANY_TYPE else kind for kind in rows)


def judges_arrival(row: TypeRow) -> bool:
    return row is _ARRIVAL


def _header(found: "re.Match[str]", kind: str, row: TypeRow) -> str:
    wanted = [one.rsplit(" ", 1) for one in found["parameters"].split(", ") if one]
    wanted += [["double", one.removesuffix(" = 0")] for one in (found["zeros"] or "").split(", ") if one]
    bound = {name: row.paths[name] for _type, name in wanted if name in row.paths}
    parameters = ", ".join(f"{of} {name}" for of, name in wanted if name in bound)
    lacking = [name for _type, name in wanted if name not in bound]
    local = f"double {', '.join(f'{name} = 0' for name in lacking)};" if lacking else ""
    if (row.parameters or row.local) and wanted:
        parameters, bound, local = row.parameters, dict(row.paths), row.local
    pattern = ", ".join(f"{path}:{name}" for name, path in bound.items())
    head = f"event {found['name']}({parameters}) {found['topic']} {kind}"
    when = found["when"] or ""
    one_line = f"{head} '{{{pattern}}}'{when} {{"
    if len(one_line) > _WIDTH:
        one_line = f"{head}\n            '{{{pattern}}}'{when} {{"
    return one_line + (f"\n        {local}" if local else "")


def _end_of(text: str, start: int) -> int:
    depth = 1
    for place in range(start, len(text)):
        depth += {"{": 1, "}": -1}.get(text[place], 0)
        if depth == 0:
            return place + 1
    raise ValueError("a block does not end")


def _cancelling(text: str) -> str:
    """Cancel all goals where the preset publishes the safe message."""
    text = _COMMAND.sub(
        lambda found: f"{found[0]}\n    topic cancel = {found[1].removesuffix('/goal')}/cancel;", text
    )
    text = _SAFE.sub(
        "actionlib_msgs::GoalID everything;                         // an empty id cancels all goals", text
    )
    return _STOP.sub("PUBLISH(cancel, actionlib_msgs/GoalID, everything);", text)
