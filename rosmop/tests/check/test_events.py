"""Events: which messages they happen for, what parameters hold, and what assigning them does to the message."""

# ruff: noqa: E501  the rows of tables

import struct

import pytest

from rosmop.check.sources import compiled_from
from rosmop.run.engine import MonitorSet
from rosmop.run.outcomes import Outcome
from rosmop.tests.acting import STORE, definitions, fields, load, message, refused
from roswire.definitions import Definitions


def event(kind: str, parameters: str, pattern: str, body: str, rest: str = "") -> str:
    """A specification with one event on `/t`."""
    return f"s() {{ {rest} event e({parameters}) /t {kind} '{{{pattern}}}' {{ {body} }} }}"


def process(text: str, data: bytes | bytearray) -> Outcome:
    """What comes of one message on `/t`."""
    return load(text).process("/t", data, 10**9)


def log_of(text: str, data: bytes) -> str:
    """What is printed for one message on `/t`; no event and no output are `-`."""
    outcome = process(text, data)
    assert not outcome.faults, outcome.faults
    return outcome.log[0].text if outcome.log else "-"


JOINTS = message(
    "sensor_msgs/JointState", header__seq=7, header__stamp__sec=3, header__stamp__nanosec=5, header__frame_id="base",
    name=["turret_pan", "turret_tilt"], position=[0.5, -0.25], velocity=[], effort=[1.0, 2.0, 3.0],
)  # fmt: skip

BINDINGS = [
    ("std::string n", "name[1]:n", '"%s", n', "turret_tilt"),
    ("std::string n", "name[0]:n", '"%s", n', "turret_pan"),
    ("string n", "name[1]:n", '"%s", n', "turret_tilt"),
    ("double p", "position[1]:p", '"%g", p', "-0.25"),
    ("float p", "position[1]:p", '"%g", p', "-0.25"),
    ("int p", "effort[2]:p", '"%d", p', "3"),
    ("bool p", "position[0]:p", '"%d", p', "1"),
    ("double[] p", "position:p", '"%d %g", (int) p.size(), p[1]', "2 -0.25"),
    ("std::vector<double> p", "position:p", '"%g", p.back()', "-0.25"),
    ("std::string[] n", "name:n", '"%s", n[1]', "turret_tilt"),
    ("std::vector<std::string> n", "name:n", '"%d", (int) n.size()', "2"),
    ("unsigned int q", "header.seq:q", '"%u", q', "7"),
    ("int q", "header:{seq:q}", '"%d", q', "7"),
    ("ros::Time t", "header.stamp:t", '"%d.%09d", t.sec, t.nsec', "3.000000005"),
    ("int t", "header.stamp.nsec:t", '"%d", t', "5"),
    ("std::string f", "header:{frame_id:f}", '"%s", f', "base"),
    ("std_msgs::Header h", "header:h", '"%d %s", h.seq, h.frame_id', "7 base"),
    ("std_msgs/Header h", "header:h", '"%d", h.seq', "7"),
    ("auto p", "position[0]:p", '"%g", p', "0.5"),
    ("double e, std::string f, int q", "effort[0]:e, header.frame_id:f, header.seq:q", '"%g %s %d", e, f, q', "1 base 7"),
    ("double e, double p", "effort[2]:e, position[0]:p", '"%g %g", e, p', "3 0.5"),
]  # fmt: skip


@pytest.mark.parametrize(("parameters", "pattern", "arguments", "text"), BINDINGS)
def test_a_binding_reads_the_field(parameters: str, pattern: str, arguments: str, text: str) -> None:
    """A parameter holds its field, converted to its type, wherever in the message it stands."""
    assert (
        log_of(event("sensor_msgs/JointState", parameters, pattern, f"ROS_INFO({arguments});"), JOINTS)
        == text
    )


def test_the_pattern_may_have_typographic_quotes() -> None:
    """Quotes as the thesis prints them are quotes."""
    text = (
        event("std_msgs/Int32", "int x", "data:x", 'ROS_INFO("%d", x);')
        .replace("'{", "\u2018{")
        .replace("}'", "}\u2019")
    )
    assert log_of(text, message("std_msgs/Int32", data=4)) == "4"


CONSTANTS = [
    ("std_msgs/Int32", "data:5", {"data": 5}, {"data": 6}),
    ("std_msgs/Int32", "data:-5", {"data": -5}, {"data": 5}),
    ("std_msgs/Int32", "data:2.0", {"data": 2}, {"data": 3}),
    ("std_msgs/Int32", "data:0x10", {"data": 16}, {"data": 10}),
    ("std_msgs/Float32", "data:0.1", {"data": 0.1}, {"data": 0.11}),
    ("std_msgs/Float64", "data:1", {"data": 1.0}, {"data": 1.5}),
    ("std_msgs/Bool", "data:true", {"data": True}, {"data": False}),
    ("std_msgs/Bool", "data:0", {"data": False}, {"data": True}),
    ("std_msgs/String", 'data:"on"', {"data": "on"}, {"data": "off"}),
    ("std_msgs/String", "data:\u201con\u201d", {"data": "on"}, {"data": "on "}),
    ("std_msgs/UInt8", "data:'a'", {"data": 97}, {"data": 98}),
    ("sensor_msgs/NavSatFix", "status:{status:sensor_msgs::NavSatStatus::STATUS_FIX}, latitude:1.5",
     {"latitude": 1.5}, {"latitude": 1.5, "status__status": -1}),
    ("sensor_msgs/JointState", 'name[1]:"b", position[0]:2', {"name": ["a", "b"], "position": [2.0]},
     {"name": ["b", "a"], "position": [2.0]}),
]  # fmt: skip


@pytest.mark.parametrize(("kind", "pattern", "equal", "other"), CONSTANTS)
def test_a_constant_in_a_pattern(
    kind: str, pattern: str, equal: dict[str, object], other: dict[str, object]
) -> None:
    """The event happens if the field equals the constant, rounded to the field's type, and only then."""
    text = event(kind, "", pattern, "")
    assert process(text, message(kind, **equal)).events == ("s.e",)
    assert process(text, message(kind, **other)).events == ()


def test_a_float_constant_of_a_message_is_a_float() -> None:
    """It is rounded to 32 bits, as the field that holds it is: the two are equal."""
    own = definitions().extended(Definitions.from_files({"own/C.msg": "float32 LIMIT=0.1\nfloat32 x\n"}))
    text = event(
        "own/C",
        "float x",
        "x:x",
        'ROS_INFO("%d %d", x == own::C::LIMIT, (double) own::C::LIMIT == 0.1);',
    )
    monitors = MonitorSet.of(compiled_from({"x.rv": text}, own))
    monitors.start(0)
    assert [line.text for line in monitors.process("/t", struct.pack("<f", 0.1), 1).log] == ["1 0"]


UINT8S, INT8S = "std_msgs/UInt8MultiArray", "std_msgs/Int8MultiArray"
RECAST = [
    (UINT8S, "char[] d", [200, 7], '"%d %d", d[0], d[1]', "-56 7"),
    (UINT8S, "std::vector<int8_t> d", [255], '"%d", d[0]', "-1"),
    (UINT8S, "std::vector<bool> d", [2, 0], '"%d %d", d[0] == true, d[1] == true', "1 0"),
    (INT8S, "uint8_t[] d", [-1, 5], '"%d %d", d[0], d[1]', "255 5"),
    (UINT8S, "uint8_t[] d", [200], '"%d", d[0]', "200"),
]


@pytest.mark.parametrize(("kind", "parameter", "data", "arguments", "text"), RECAST)
def test_bytes_are_converted_one_by_one(
    kind: str, parameter: str, data: list[int], arguments: str, text: str
) -> None:
    """An array of bytes bound to one of another kind of byte has the values that C++ gives each of them."""
    assert (
        log_of(event(kind, parameter, "data:d", f"ROS_INFO({arguments});"), message(kind, data=data)) == text
    )


WRITTEN_BYTES = [
    (UINT8S, "char[] d", [1, 2], "d[0] = -1;", [255, 2]),
    (INT8S, "uint8_t[] d", [-1, 2], "d[1] = 200;", [-1, -56]),
    (UINT8S, "std::vector<bool> d", [0, 7], "d[0] = true;", [1, 1]),
    (UINT8S, "uint8_t[] d", [1], "std::vector<int8_t> v; v.push_back(-3); d = v;", [253]),
    (UINT8S, "uint8_t[] d", [1], "std::vector<char> v{-3}; d = true ? d : v; d[0]++;", [2]),
    (INT8S, "int8_t[] d", [1], "std::vector<std::vector<uint8_t> > v; std::vector<std::vector<char> > c{{-3}}; v = c; d[0] = v[0][0] == 253;", [1]),
]  # fmt: skip


@pytest.mark.parametrize(("kind", "parameter", "data", "body", "written"), WRITTEN_BYTES)
def test_bytes_are_converted_where_they_are_written(
    kind: str, parameter: str, data: list[int], body: str, written: list[int]
) -> None:
    """What is assigned to an array of bytes is sent as C++ converts it, and is no fault."""
    outcome = process(event(kind, parameter, "data:d", body), message(kind, data=data))
    assert not outcome.faults, outcome.faults
    assert list(fields(kind, bytes(outcome.buffer)).data) == written


HALF = [
    ("int q, double[] c", "header.seq:q, orientation_covariance:c", "q = 5; std::vector<double> v(3); c = v;"),
    ("std::string f, double[] c", "header.frame_id:f, orientation_covariance:c", 'f = "longer"; std::vector<double> v; c = v;'),
    ("double[] c, int q", "orientation_covariance:c, header.stamp.nsec:q", "std::vector<double> v(10); c = v; q = 5;"),
]  # fmt: skip


@pytest.mark.parametrize(("parameters", "pattern", "body"), HALF)
def test_an_action_that_faults_as_its_changes_are_written_changes_nothing(
    parameters: str, pattern: str, body: str
) -> None:
    """With `on_fault: pass` a message goes on as it came, not with some of the changes."""
    data = message("sensor_msgs/Imu", header__frame_id="base")
    monitors = load(event("sensor_msgs/Imu", parameters, pattern, body), "pass")
    outcome = monitors.process("/t", data, 1)
    assert "elements for an array of exactly 9" in outcome.faults[0].text
    assert outcome.result == "passed"


BOUND_TWICE = [
    ("double[] p, double a", "position:p, position[0]:a", "a = 9;"),
    ("double[] p, double a", "position:p, position[0]:a", "p[0] = 9;"),
    ("double a, double b", "position[1]:a, position[1]:b", "b = 9;"),
    ("std_msgs/Header h, int a", "header:h, header.seq:a", "a = 9;"),
]


@pytest.mark.parametrize(("parameters", "pattern", "body"), BOUND_TWICE)
def test_a_field_that_is_assigned_is_bound_once(parameters: str, pattern: str, body: str) -> None:
    """Also as part of a whole that is bound: one change would undo the other."""
    found = refused(event("sensor_msgs/JointState", parameters, pattern, body))
    assert "two bindings hold this field" in found[0].text


def test_two_elements_of_an_array_are_two_fields() -> None:
    """Both may be assigned."""
    text = event("sensor_msgs/JointState", "double a, double b", "position[0]:a, position[1]:b", "a = b = 9;")
    assert list(fields("sensor_msgs/JointState", bytes(process(text, JOINTS).buffer)).position) == [9, 9]


BAD_CONSTANTS = [
    ("std_msgs/Int32", "data:2.5", "a field of type int cannot hold 2.5"),
    ("std_msgs/UInt8", "data:256", "a field of type uint8_t cannot hold 256"),
    ("std_msgs/UInt8", "data:-1", "a field of type uint8_t cannot hold -1"),
    ("std_msgs/Float32", "data:1e39", "a field of type float cannot hold 1e+39"),
    ("std_msgs/Bool", "data:2", "a field of type bool cannot hold 2"),
    ("std_msgs/Int32", 'data:"x"', "a field of type int cannot hold 'x'"),
    ("std_msgs/String", "data:1", "a field of type std::string cannot hold 1"),
    ("std_msgs/Header", "stamp:1", "a field of type ros::Time cannot hold 1"),
]


@pytest.mark.parametrize(("kind", "pattern", "text"), BAD_CONSTANTS)
def test_a_constant_that_its_field_cannot_hold(kind: str, pattern: str, text: str) -> None:
    """Such a constant is refused when the specification is loaded, where it stands."""
    [finding] = refused(event(kind, "", pattern, ""))
    assert finding.text == text
    assert (
        finding.position.column
        == 6 + len(f" event e() /t {kind} '{{") + len("data:" if "data" in pattern else "stamp:") + 1
    )


CHANGES = [
    ("std_msgs/Int32", "int x", "data:x", "x = 5;", {"data": 1}, {"data": 5}),
    ("std_msgs/Int32", "double x", "data:x", "x = x / 2;", {"data": 5}, {"data": 2}),
    ("std_msgs/UInt8", "int x", "data:x", "x = 300;", {"data": 1}, {"data": 44}),
    ("std_msgs/Float32", "double x", "data:x", "x = 0.1;", {"data": 1}, {"data": struct.unpack("f", struct.pack("f", 0.1))[0]}),
    ("std_msgs/Float64", "int x", "data:x", "x = x;", {"data": 2.7}, {"data": 2.0}),
    ("std_msgs/Bool", "bool x", "data:x", "x = !x;", {"data": False}, {"data": True}),
    ("std_msgs/String", "std::string x", "data:x", 'x = x + "RV";', {"data": "hi"}, {"data": "hiRV"}),
    ("std_msgs/String", "std::string x", "data:x", "x.clear();", {"data": "hi"}, {"data": ""}),
    ("std_msgs/String", "std::string x", "data:x", "x[0] = 'H';", {"data": "hi"}, {"data": "Hi"}),
    ("std_msgs/Header", "ros::Time t", "stamp:t", "t = ros::Time(9, 8);", {}, {"stamp__sec": 9, "stamp__nanosec": 8}),
    ("std_msgs/Header", "int t", "stamp.nsec:t", "t = 6;", {"stamp__sec": 1}, {"stamp__sec": 1, "stamp__nanosec": 6}),
    ("std_msgs/Header", "std::string f, int q", "frame_id:f, seq:q", 'f = "map"; q = 3;', {"frame_id": "base"},
     {"frame_id": "map", "seq": 3}),
    ("sensor_msgs/JointState", "double p", "position[1]:p", "p = 9;", {"position": [1.0, 2.0]}, {"position": [1.0, 9.0]}),
    ("sensor_msgs/JointState", "std::string n", "name[1]:n", 'n = "zz";', {"name": ["a", "b", "c"]}, {"name": ["a", "zz", "c"]}),
    ("sensor_msgs/JointState", "std::string a, std::string b", "name[1]:a, name[0]:b", 'a = "long"; b = "";',
     {"name": ["a", "b"]}, {"name": ["", "long"]}),
    ("sensor_msgs/JointState", "double[] p, std::string n", "position:p, name[0]:n", 'p.push_back(3); n += "!";',
     {"name": ["a"], "position": [1.0]}, {"name": ["a!"], "position": [1.0, 3.0]}),
    ("sensor_msgs/JointState", "double[] p", "position:p", "p[0] = 4;", {"position": [1.0]}, {"position": [4.0]}),
    ("sensor_msgs/JointState", "double[] p", "position:p", "for (double& q : p) q *= 2;", {"position": [1.0, 2.0]},
     {"position": [2.0, 4.0]}),
    ("geometry_msgs/TwistStamped", "geometry_msgs::Vector3 v", "twist.linear:v", "v.x = 1; v.z = v.y;",
     {"twist__linear__y": 5.0, "header__frame_id": "b"}, {"twist__linear__x": 1.0, "twist__linear__y": 5.0,
     "twist__linear__z": 5.0, "header__frame_id": "b"}),
    ("geometry_msgs/PoseWithCovariance", "double c", "covariance[35]:c", "c = 2;", {}, {"covariance": [0.0] * 35 + [2.0]}),
    ("geometry_msgs/PoseWithCovariance", "double[] c", "covariance:c", "c[1] = 2;", {}, {"covariance": [0.0, 2.0] + [0.0] * 34}),
]  # fmt: skip


@pytest.mark.parametrize(("kind", "parameters", "pattern", "body", "before", "after"), CHANGES)
def test_assigning_a_parameter_changes_the_message(  # noqa: PLR0917  a row of the table
    kind: str, parameters: str, pattern: str, body: str, before: dict[str, object], after: dict[str, object]
) -> None:
    """The message that is relayed is the one another encoder makes of the changed fields, byte for byte."""
    outcome = process(event(kind, parameters, pattern, body), message(kind, **before))
    assert not outcome.faults
    assert bytes(outcome.buffer) == message(kind, **after)
    assert outcome.result == "changed"


def test_a_change_of_fixed_size_is_made_in_place() -> None:
    """A number is written into the buffer that came in; no other buffer is made."""
    buffer = bytearray(message("std_msgs/Int32", data=1))
    assert process(event("std_msgs/Int32", "int x", "data:x", "x = 2;"), buffer).buffer is buffer
    assert buffer == message("std_msgs/Int32", data=2)


def test_a_writable_view_is_changed_in_place_and_a_readonly_one_is_not() -> None:
    """The relay hands in views of its receive buffer; what cannot be written is copied first."""
    text = event("std_msgs/Int32", "int x", "data:x", "x = 2;")
    received = bytearray(b"??" + message("std_msgs/Int32", data=1))
    outcome = load(text).process("/t", memoryview(received)[2:], 0)
    assert bytes(received) == b"??" + bytes(outcome.buffer) == b"??" + message("std_msgs/Int32", data=2)
    readonly = memoryview(message("std_msgs/Int32", data=1))
    assert bytes(load(text).process("/t", readonly, 0).buffer) == message("std_msgs/Int32", data=2)
    assert bytes(readonly) == message("std_msgs/Int32", data=1)


UNCHANGED = [
    ("std_msgs/Float64", "int x", "data:x", "int y = x;", {"data": 2.7}),
    ("std_msgs/Float64", "int x", "data:x", "if (x > 100) x = 1;", {"data": 2.7}),
    ("std_msgs/Int32", "int x", "data:x", "x = x;", {"data": 2}),
    ("std_msgs/Int32", "int x", "data:x", "x = x + 1; x = x - 1;", {"data": 2}),
    ("std_msgs/String", "std::string x", "data:x", 'x = "hi";', {"data": "hi"}),
    ("sensor_msgs/JointState", "double[] p", "position:p", "double y = p[0];", {"position": [1.0]}),
]


@pytest.mark.parametrize(("kind", "parameters", "pattern", "body", "before"), UNCHANGED)
def test_what_is_not_assigned_or_equal_is_not_changed(
    kind: str, parameters: str, pattern: str, body: str, before: dict[str, object]
) -> None:
    """A converted parameter is written back only if assigned, and equal bytes are no change."""
    outcome = process(event(kind, parameters, pattern, body), message(kind, **before))
    assert (outcome.result, bytes(outcome.buffer)) == ("passed", message(kind, **before))


def test_two_events_that_undo_each_other_change_nothing() -> None:
    """`changed` means that the bytes differ from those received, not that somebody wrote."""
    text = """s() { event a(int x) /t std_msgs/Int32 '{data:x}' { x++; }
                    event b(int x) /t std_msgs/Int32 '{data:x}' { x--; } }"""
    assert process(text, message("std_msgs/Int32", data=1)).result == "passed"


def test_a_later_event_sees_what_an_earlier_one_changed() -> None:
    """Events see the message as it stands."""
    text = """s() { event a(std::string x) /t std_msgs/String '{data:x}' { x += "longer"; }
                    event b(std::string x) /t std_msgs/String '{data:x}' { ROS_INFO("%s", x); } }"""
    assert log_of(text, message("std_msgs/String", data="a")) == "alonger"


def test_an_index_past_the_end() -> None:
    """The event does not happen, nothing faults, and it is told once in a minute with a count."""
    monitors = load(event("sensor_msgs/JointState", "double p", "position[2]:p", ""))
    short = message("sensor_msgs/JointState", position=[1.0])
    told = []
    for second in (0, 1, 2, 61):
        outcome = monitors.process("/t", short, second * 10**9)
        assert (outcome.events, outcome.faults, outcome.result) == ((), (), "passed")
        told += [line.text for line in outcome.log]
    assert told == [
        "s.e did not happen: index 2 is past the end of 1 elements",
        "s.e did not happen: index 2 is past the end of 1 elements (3 times)",
    ]


def test_when_decides_whether_the_event_happens() -> None:
    """`when` sees parameters and shared variables; a fault in it is a fault of the event."""
    text = """s() { int least = 3; event e(int x) /t std_msgs/Int32 '{data:x}' when (12 / x > least) { ROS_INFO("e"); } }"""
    assert log_of(text, message("std_msgs/Int32", data=2)) == "e"
    assert log_of(text, message("std_msgs/Int32", data=6)) == "-"
    outcome = process(text, message("std_msgs/Int32", data=0))
    assert (outcome.result, outcome.events) == ("dropped", ())
    assert [(fault.text, fault.values) for fault in outcome.faults] == [("division by zero", {"x": 0})]


def test_message_copies_everything_with_what_was_assigned() -> None:
    """`MESSAGE` is the message as the action has changed it so far; the copy is not the message."""
    text = event(
        "geometry_msgs/TwistStamped",
        "double x, std::string f, int n",
        "twist.linear.x:x, header.frame_id:f, header.stamp.nsec:n",
        """x = 2; f = "new"; n = 7; v = MESSAGE; v.twist.linear.y = 9;
           ROS_INFO("%g %s %d", v.twist.linear.x, v.header.frame_id, v.header.stamp.nsec);""",
        "geometry_msgs::TwistStamped v;",
    )
    outcome = process(text, message("geometry_msgs/TwistStamped", twist__linear__x=1.0))
    assert outcome.log[0].text == "2 new 7"
    changed = fields("geometry_msgs/TwistStamped", bytes(outcome.buffer))
    assert changed.twist.linear.y == 0


def test_drop_and_return() -> None:
    """`return;` ends the action and drops; `DROP;` drops and what follows still runs."""
    returned = process(
        event("std_msgs/Int32", "int x", "data:x", 'x = 9; return; ROS_INFO("no");'),
        message("std_msgs/Int32"),
    )
    assert (returned.result, returned.log) == ("dropped", ())
    dropped = process(
        event("std_msgs/Int32", "int x", "data:x", 'DROP; ROS_INFO("yes");'), message("std_msgs/Int32")
    )
    assert (dropped.result, [line.text for line in dropped.log]) == ("dropped", ["yes"])


SIMPLE_TYPES = sorted(
    name.replace("/msg/", "/")
    for name in STORE.fielddefs
    if name.split("/")[0] in ("geometry_msgs", "nav_msgs", "sensor_msgs", "std_msgs", "diagnostic_msgs", "trajectory_msgs")
)  # fmt: skip


@pytest.mark.parametrize("kind", SIMPLE_TYPES)
def test_a_message_survives_a_copy_and_a_publish(kind: str) -> None:
    """Decoding and encoding any of ROS's messages gives the same bytes, in agreement with another encoder."""
    data = message(kind)
    text = event(kind, "", "", f"v = MESSAGE; PUBLISH(/copy, {kind}, v);", f"{kind} v;")
    outcome = process(text, data)
    assert not outcome.faults
    assert [(each.topic, each.type, each.data) for each in outcome.published] == [("/copy", kind, data)]


@pytest.mark.parametrize(
    "kind", ["sensor_msgs/JointState", "nav_msgs/Odometry", "sensor_msgs/LaserScan", "nav_msgs/Path"]
)
def test_a_message_with_content_survives(kind: str) -> None:
    """The same with strings, arrays and nested messages in it."""
    given: dict[str, dict[str, object]] = {
        "sensor_msgs/JointState": {"name": ["a", "", "ccc"], "position": [1.5, float("inf")], "header__frame_id": "x"},
        "nav_msgs/Odometry": {"child_frame_id": "b", "pose__covariance": [float(i) for i in range(36)], "header__stamp__sec": 4},
        "sensor_msgs/LaserScan": {"ranges": [0.5, 1.5, 2.5], "angle_min": -1.0},
        "nav_msgs/Path": {"poses": [{"header": {"frame_id": "one"}}, {"header": {"frame_id": "two"}, "pose": {"position": {"x": 5.0}}}]},
    }  # fmt: skip
    data = message(kind, **given[kind])
    outcome = process(event(kind, "", "", f"v = MESSAGE; PUBLISH(/copy, {kind}, v);", f"{kind} v;"), data)
    assert [each.data for each in outcome.published] == [data]


def test_fields_of_elements_of_arrays() -> None:
    """A path goes through elements of arrays of messages of variable size."""
    poses = [
        {"header": {"frame_id": "one"}},
        {"header": {"frame_id": "two"}, "pose": {"position": {"x": 5.0}}},
    ]
    data = message("nav_msgs/Path", poses=poses, header__frame_id="map")
    text = event("nav_msgs/Path", "double x, std::string f", "poses[1]:{pose.position.x:x, header.frame_id:f}",
                 'ROS_INFO("%g %s", x, f); x = 7; f = "three";')  # fmt: skip
    outcome = process(text, data)
    assert outcome.log[0].text == "5 two"
    after = fields("nav_msgs/Path", bytes(outcome.buffer))
    assert after.poses[1].pose.position.x == 7
    assert (after.poses[1].header.frame_id, after.poses[0].header.frame_id) == ("three", "one")


@pytest.mark.parametrize("length", range(len(JOINTS)))
def test_a_message_that_is_cut_short_is_a_fault(length: int) -> None:
    """Bytes that are no message of the type are dropped and recorded, however they are cut."""
    text = event("sensor_msgs/JointState", "double[] e", "effort:e", "double y = e[0];")
    outcome = process(text, JOINTS[:length])
    assert (outcome.result, len(outcome.faults)) == ("dropped", 1)


REFUSED = [
    ("int x", "dat:x", "std_msgs/Int32 has no field `dat`; did you mean `data`?", 42),
    ("int x", "data:y", "there is no parameter `y`; there are: x", 47),
    ("int x, int y", "data:x", "the parameter `y` is bound to no field; write `field:y`", 22),
    ("int x, int x", "data:x", "the parameter `x` occurs twice", 22),
    ("std::string x", "data:x", "`data` is int and cannot be bound to std::string", 15),
    ("int[] x", "data:x", "`data` is int and cannot be bound to std::vector<int>", 15),
    ("int x", "data[0]:x", "`data` is int, no array; leave out the index", 42),
    ("int x", "data.y:x", "int has no field `y`", 47),
    ("foo x", "data:x", "there is no type `foo`", 15),
]


@pytest.mark.parametrize(("parameters", "pattern", "text", "column"), REFUSED)
def test_a_pattern_that_does_not_fit(parameters: str, pattern: str, text: str, column: int) -> None:
    """A binding that cannot work is refused with its exact place."""
    spec = f"s() {{ event e({parameters}) /t std_msgs/Int32 '{{{pattern}}}' {{ }} }}"
    found = [(finding.position.column, text in finding.text) for finding in refused(spec)]
    assert (column, True) in found


def test_an_unused_variable_binds_nothing() -> None:
    """A variable of a pattern that no parameter names is accepted, as by ROSMOP, with a warning at its place."""
    spec = "s() { event e(int x) /t std_msgs/ColorRGBA '{r:x, g:y}' { } }"
    spec = spec.replace("int x", "float x")
    [finding] = [one for one in load(spec).warnings if "`y`" in one.text]
    assert (finding.severity, finding.position.column) == ("warning", spec.index("y}") + 1)
    assert "`y` is not a parameter of the event, so it binds nothing" in finding.text
    assert any("has no field `q`" in error.text for error in refused(spec.replace("g:y", "q:y")))
    sliced = refused(spec.replace("s() {", "s(float y) {"))
    assert any("there is no parameter `y`" in error.text for error in sliced)


def test_a_path_that_skips_a_message_is_answered_with_the_right_one() -> None:
    """The mistake of ROSRV's own sample: `pose.position` of an odometry is `pose.pose.position`."""
    text = event("nav_msgs/Odometry", "double x", "pose: {position: {x:x}}", "")
    assert "did you mean `pose.position`?" in refused(text)[0].text
    [finding] = refused(event("nav_msgs/Odometry", "int[] x", "pose.pose.position:x", ""))
    assert "geometry_msgs::Point and cannot be bound" in finding.text


def test_an_index_past_a_fixed_array_is_an_error_at_load() -> None:
    """What can never happen is refused."""
    text = event("geometry_msgs/PoseWithCovariance", "double c", "covariance[36]:c", "")
    assert refused(text)[0].text == "`covariance` has 36 elements; 36 is past the end"


def test_a_field_bound_twice_cannot_be_assigned() -> None:
    """Two references to the same bytes may be read, but not written."""
    pattern = "header:h, header.seq:q"
    good = event("sensor_msgs/JointState", "std_msgs::Header h, int q", pattern, "int y = q + h.seq;")
    assert not process(good, JOINTS).faults
    bad = event("sensor_msgs/JointState", "std_msgs::Header h, int q", pattern, "q = 1;")
    assert "two bindings hold this field" in refused(bad)[0].text


def test_an_unknown_type_is_answered_with_the_nearest() -> None:
    """Types that nobody defines are refused, and the message says where definitions come from."""
    [finding] = refused(event("std_msgs/Strin", "", "", ""))
    assert "did you mean `std_msgs/String`?" in finding.text
    assert "--msg DIR" in finding.text


@pytest.mark.parametrize(
    "when", ["n++ > 0", "(n = 1) > 0", "v[0]++ > 0", "(m.data = 1) == 1", "f()", "g()", "h(n)"]
)
def test_a_condition_changes_nothing(when: str) -> None:
    """`when` only looks, at parameters and at shared variables."""
    before = """int n; std::vector<int> v; std_msgs::Int32 m; bool g() { return f() && n; }
        bool f() { v.push_back(1); return true; } bool h(int& a) { return true; } bool i() { int a = n; return a++; }"""
    text = f"s() {{ {before} event e() /t std_msgs/Int32 '{{}}' when ({when}) {{ }} }}"
    assert refused(text)[0].text == "`when` only looks; assign in the action"
    assert process(text.replace(f"({when})", "(i() || true)"), message("std_msgs/Int32")).events == ("s.e",)


def test_a_constant_of_a_message_may_be_named_through_a_variable() -> None:
    """As in C++."""
    text = event(
        "rosgraph_msgs/Log",
        "int n",
        "level:n",
        'rosgraph_msgs::Log d; ROS_INFO("%d", d.WARN == rosgraph_msgs::Log::WARN); switch (n) { case d.ERROR: return; }',
    )
    assert log_of(text, message("rosgraph_msgs/Log")) == "1"
    assert process(text, message("rosgraph_msgs/Log", level=8)).result == "dropped"
    assert "needs a variable" in refused(text.replace("switch", "d.WARN = 3; switch"))[0].text


@pytest.mark.parametrize("kind", ["double[] &p", "std::vector<double>& p", "double p[]"])
def test_references_to_arrays_are_taken(kind: str) -> None:
    """As in the specifications of ROSRV: a parameter is a reference into the message, with `&` or without."""
    text = "s() { void twice(double[] &v) { for (double& one : v) { one *= 2; } }"
    text += f"event e({kind}) /t sensor_msgs/JointState '{{position:p}}' {{ twice(p); }} }}"
    outcome = load(text).process("/t", message("sensor_msgs/JointState", position=[1.0, 2.0]), 0)
    assert not outcome.faults
    assert list(fields("sensor_msgs/JointState", bytes(outcome.buffer)).position) == [2.0, 4.0]
