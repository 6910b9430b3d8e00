"""Typed topics, roles, given lists and the `preset` statement."""

from itertools import product

import pytest

from rosmop.check.sources import compiled_from
from rosmop.form.findings import SpecificationError
from rosmop.logics.tfsm import TimedStateMachine
from rosmop.run.engine import MonitorSet
from rosmop.tests.acting import definitions, fields, load, message, refused
from rosmop.tests.on_module import on_module
from rosmop.text.parser import parse, roles
from rosmop.types import given_lists
from rosmop.types.roles import ANY_TYPE, types_of_roles

CAP = """cap() given { topic command : Velocity = /cmd_vel; double most = 1 in 0..9; } {
    safe { } on command every 100ms;
    event drive(x, rz, steer) command when (x == x) { if (x > most || steer != 0) { x = most; } }
    event tick() every 1s { if (most < 0) { STOP; } } }"""
IN_PLAIN = """own() given { topic command = /c; double most = 2 in 0..9; } {
    safe geometry_msgs/TwistStamped { } on command every 100ms;
    event drive(double x, double rz) command geometry_msgs/TwistStamped '{twist.linear.x:x, twist.angular.z:rz}'
            when (x == x) { double steer = 0; if (x > most || steer != 0) { x = most; } }
    event tick() every 1s { if (most < 0) { STOP; } } }"""
FENCE = """preset fence 1 as yard { fence = POLYGON; }
    begin fence() given { corners fence = 0,0 1,0 1,1 m; topic at = /at; } {
    int seen;
    event at(double x, double y) at geometry_msgs/Point '{x:x, y:y}' {
        seen++; if (!inside(x, y, fence)) { x = fence[0]; y = seen; } } }"""


def test_a_preset_statement_gives_name_topics_types_and_values() -> None:
    """The result is the tree of a text that has them everywhere."""
    typed = parse(
        f"preset cap 3 as own {{ command = /c geometry_msgs/TwistStamped; most = 2; }}\n{CAP}", "x.rv"
    )
    assert typed.specifications == parse(IN_PLAIN, "x.rv").specifications
    assert parse(f"preset cap 3;\n{CAP}", "x.rv").specifications == parse(CAP, "x.rv").specifications


def test_a_value_of_a_row_is_made_by_its_statements_and_has_its_type() -> None:
    text = """preset s 1 as s {{ by = /by {kind}; }}
        s() given {{ topic by : Sensor = /by; }} {{ Sensor::values last; event e(values) by {{ last = values; }} }}"""
    for kind, data, last in (
        ("sensor_msgs/LaserScan", {"ranges": [0.5, 2.0]}, [0.5, 2.0]),
        ("sensor_msgs/Range", {"range": 3.0}, [3.0]),
        ("sensor_msgs/NavSatFix", {"latitude": float("nan")}, []),
    ):
        monitors = on_module(compiled_from({"x.rv": text.format(kind=kind)}, definitions()), "drop")
        monitors.start(0)
        monitors.judge("/by", message(kind, **data), 1)
        assert [*monitors.value("s", "last")] == last


def test_a_command_that_cannot_stop_is_dropped_and_its_goals_are_cancelled() -> None:
    text = """preset s 1 as s { command = /arm/goal move_base_msgs/MoveBaseActionGoal; }
        s() given { topic command : Command = /cmd_vel; } { safe { } on command every 100ms;
        event drive(x) command { if (x == 0) { STOP; } } event tick() every 1s { STOP; } }"""
    [drive, tick] = parse(text, "x.rv").specifications[0].events
    assert "DropStatement" in repr(drive) and "StopStatement" not in repr(drive)
    assert "PublishStatement" in repr(tick) and "StopStatement" not in repr(tick)
    [code] = compiled_from({"x.rv": text}, definitions()).specifications
    assert ({*code.safes}, [given_topic.topic for given_topic in code.given_topics]) == (set(), ["/arm/goal"])
    loaded = compiled_from(
        {"x.rv": text}, definitions(), topics={"s": {"command": "/leg/goal", "cancel": "/x"}}
    )
    assert {publication.topic for publication in loaded.publications} == {"/leg/cancel"}
    for both in ("cancel = /x; topic command : Command", "command : Command = /cmd_vel; topic cancel"):
        errors = refused(text.replace("command : Command", both, 1))
        assert [error.text for error in errors] == ["the topic `cancel` is given twice"]


@pytest.mark.parametrize("module", [True, False])
def test_other_corners_keep_the_state(module: bool) -> None:
    def monitors(polygon: str) -> MonitorSet:
        compiled = compiled_from({"x.rv": FENCE.replace("POLYGON", polygon)}, definitions())
        return on_module(compiled, "drop") if module else MonitorSet.of(compiled)

    def judged(these: MonitorSet, time: int) -> tuple[float, float]:
        read = fields(
            "geometry_msgs/Point",
            bytes(these.judge("/at", message("geometry_msgs/Point", x=3.0), time).buffer),
        )
        return read.x, read.y

    small, large, other = monitors("0,0 1,0 1,1"), monitors("0,0 9,-1 9,9"), monitors("-7,0 1,0 1,1")
    small.start(0)
    assert judged(small, 1) == (0, 1)
    large.succeed(small, 2)
    assert (large.began, judged(large, 3)) == ((), (3, 0))
    other.recover(
        [(one.names, one.layout, one.base(), one.cells() or None) for one in large.kept_groups()], {}, 4
    )
    assert judged(other, 5) == (-7, 3)


def test_hosts_and_times_are_given() -> None:
    text = """preset w 1 as w { to = 10.0.0.7; limit = 250ms; }
        w() given { hosts to = 0.0.0.0/0; time limit = 2s; } { withhold /t from to while hidden; bool hidden = true;
        event e() /t std_msgs/Empty '{}' { }
        tfsm: on [ e -> on, timeout limit -> late ] late [ e -> on ] @late { hidden = false; } }"""
    one = compiled_from({"x.rv": text}, definitions()).specifications[0]
    assert one.withholdings[0].networks == ("10.0.0.7/32",)
    assert isinstance(machine := one.properties[0].property, TimedStateMachine)
    assert machine.timeouts[0] == (250 * 10**6, 1)
    plain = parse(text.replace("to = 10.0.0.7; ", ""), "x.rv").specifications[0]
    assert plain.withholds[0].given == ("0.0.0.0/0",)
    others = [text.replace("10.0.0.7", "10.0.0.8"), text.replace("250ms", "251ms")]
    codes = [compiled_from({"x.rv": other}, definitions()).specifications[0] for other in others]
    assert [code.identity == one.identity for code in codes] == [True, False]


WRONG = [
    ("topic t : Velocety = /t;", "e(x) t", "", "no role `Velocety`; did you mean `Velocity`"),
    ("topic t : Velocity = /t;", "e(v) t", "", "Velocity has no value `v`"),
    ("topic t = /t;", "e(x) t", "", "`t` has no role here"),
    ("topic t : Velocity = /t;", "e(x) t", "t = /t std_msgs/Bool;", "/t cannot have the type `std_msgs/Bool`"),
    ("topic t : Velocity = /t;", "e(x) t", "tt = /t;", "`tt` is not given to it"),
    ("topic t : Velocity = /t;", "e(x) t", "t = /t; t = /u;", "`t` is set twice"),
    ("topic t : Velocity = /t; double d = 1 in 0..2;", "e(x) t", "d = 3;", "the default 3 of `d` is outside"),
    ("topic t : Velocity = /t; corners c = 0,0 1,1 1,0;", "e(x) t", "c = 0,0 1,1;", "write it like c = -2,-2"),
    ("topic t : Velocity = /t; corners c = 0,0 1,1 1,0;", "e(x) t", "c = 0,0 2,2 2,0 0,2;", "edges cross"),
    ("topic t : Velocity = /t; time c = 0s;", "e(x) t", "", "write it like c = 120s"),
    ("topic t : Velocity = /t; double d = 1 in 0..2;", "e(x) t", "d = fast;", "`fast`: write a number, such as d = 1"),
    ("topic t : Velocity = /t; double d = 1 m in 0..2;", "e(x) t", "d = 1 m;", "`1 m`: write a number without its"),
    ("topic t : Velocity = /t; double d = 1 in 0..2;", "e(x) t", "d = ;", "``: write a number"),
    ("topic t : Velocity = /t; double d = 1 in 0..2;", "e(x) t", "d = true;", "`true`: write a number"),
    ("topic t : Velocity = /t; bool d = true;", "e(x) t", "d = 1;", "`1`: write d = true or d = false"),
    ("topic t : Velocity = /t;", "e(x) t", "t = cmd;", "`cmd` is not a topic; write it like t = /cmd_vel"),
    ("topic t : Velocity = /t; topic u = /u;", "e(x) t", "u = /v std_msgs/Bool;", "like u = /cmd_vel, without a type"),
    ("topic t : Velocity = /t; double t = 1 in 0..2;", "e(x) t", "", "`t` is given twice"),
    ("topic t : Velocity = /t; hosts c = ::/0; hosts c = ::/0;", "e(x) t", "", "`c` is given twice"),
    ("topic t : Velocity = /t; joints c = a:0..1 a:0..2;", "e(x) t", "", "a occurs twice; write it like c = elbow"),
    ("topic t : Velocity = /t; joints c = a:1..0;", "e(x) t", "", "the lower limit of a is above the upper one"),
    ("topic t : Velocity = /t;", "e(y) t when (y > 0)", "t = /t ackermann_msgs/AckermannDrive;",
     "`y` is not a field of ackermann_msgs/AckermannDrive: test it in the action"),
]  # fmt: skip


@pytest.mark.parametrize(("given", "event", "settings", "why"), WRONG)
def test_a_wrong_type_or_value_is_refused(given: str, event: str, settings: str, why: str) -> None:
    errors = refused(f"preset s 1 as s {{ {settings} }} s() given {{ {given} }} {{ event {event} {{ }} }}")
    assert any(why in error.text for error in errors), errors


def test_each_kind_of_value_of_a_preset_statement_is_checked_at_its_place() -> None:
    """Any text between `=` and `;` is read, so each kind has to check it."""
    given = """topic t : Velocity = /t; topic u = /u; double d = 1 in 0..2; int i = 1 in 0..2; bool b = true;
        corners c = 0,0 1,1 1,0; joints j = none; hosts h = ::/0; time s = 1s;"""
    for name, value in product("tudibcjhs", ("", "x", "1e999", "0x1", "/ //", "1 // one", "nan", "-", '"')):
        text = f"preset s 1 as s {{\n  {name} = {value};\n}} s() given {{ {given} }} {{ event e(x) t {{ }} }}"
        errors = refused(text)
        assert errors and {(error.position.line, error.position.column) for error in errors} == {(2, 3)}, (
            name,
            value,
        )


def test_a_specification_cancels_the_goals_of_one_action() -> None:
    action = "move_base_msgs/MoveBaseActionGoal"
    errors = refused(f"""preset s 1 as s {{ t = /a/goal {action}; u = /b/goal {action}; }}
        s() given {{ topic t : Command = /t; topic u : Command = /u; }} {{
        safe {{ }} on t every 1s; safe {{ }} on u every 1s; event e() t {{ STOP; }} event f() u {{ STOP; }} }}""")
    assert any("cancels the goals of one action" in error.text for error in errors)


def test_a_preset_statement_needs_its_specification() -> None:
    for text, why in (
        (f"preset cup 1;\n{CAP}", "no specification `cup`; did you mean `cap`"),
        (f"preset cap 1; preset cap 2;\n{CAP}", "leave this one out"),
        (f"preset cap 1 as own {{ most = 2 }}\n{CAP}", "a preset is `preset name 1 as other"),
        ("role V(double x) { std_msgs/Float64 {data:x} }", "a role is `role Name"),
    ):
        with pytest.raises(SpecificationError, match=why):
            parse(text, "x.rv")


def test_a_file_has_roles_of_its_own() -> None:
    role = "role Level(double v) { std_msgs/Float64 '{data:v}'; }"
    monitors = load(f"{role} s() given {{ topic t : Level = /t; }} {{ event e(v) t {{ v = 1; }} }}")
    outcome = monitors.process("/t", message("std_msgs/Float64"), 1)
    assert fields("std_msgs/Float64", bytes(outcome.buffer)).data == 1


def test_a_value_that_the_type_of_an_own_role_lacks_has_its_type() -> None:
    role = """role Own(std::string s, double[] a, double u) {
        std_msgs/Float64 '{data:u}'; std_msgs/String '{data:s}'; }"""
    use = '{ if (s == "" && a.size() == 0) { u = 1; } }'
    monitors = load(f"{role} s() given {{ topic t : Own = /t; }} {{ event e(s, a, u) t {use} }}")
    outcome = monitors.process("/t", message("std_msgs/Float64"), 1)
    assert fields("std_msgs/Float64", bytes(outcome.buffer)).data == 1


def test_a_role_has_a_name_and_a_type() -> None:
    code = "s() given { topic t : Own = /t; } { event e() t { } }"
    for own, why in (
        (
            "role Own() { std_msgs/Bool '{}'; } role Own() { std_msgs/Bool '{}'; }",
            "there is another role `Own`",
        ),
        ("role Own() { }", "no type of /t is known; begin Own with a row"),
        ("role Own() { default '{}'; }", "no type of /t is known; begin Own with a row"),
    ):
        assert any(why in one.text for one in refused(f"{own} {code}"))


def test_a_role_has_the_values_of_all_that_it_extends() -> None:
    def roles_with(base: str) -> str:
        row = "std_msgs/Float64 '{data:v}';"
        return f"role Own(double v) : Other {{ {row} }} role Other(double w) : {base} {{ }}"

    code = "s() given { topic t : Own = /t; } { event e(px, v, w) t { } }"
    kind = "preset s 1 as s { t = /t nav_msgs/Odometry; }"
    [event] = parse(f"{kind} {roles_with('Position')} {code}", "x.rv").specifications[0].events
    assert [parameter.name for parameter in event.parameters] == ["px"]
    assert any("circle of roles" in one.text for one in refused(f"{roles_with('Own')} {code}"))


@pytest.mark.parametrize("role", types_of_roles())
def test_each_row_of_a_role_has_its_values(role: str) -> None:
    """Each type is known, and its fields have the types of the values."""
    for kind in types_of_roles()[role]:
        name = kind.replace(ANY_TYPE, "std_msgs/Header")
        given = f"topic t : {role} = /t; double lat0 = 0 in 0..1; double lon0 = 0 in 0..1; int button = 0 in 0..9;"
        own = roles()[role]
        values = (*(roles()[own.base].parameters if own.base else ()), *own.parameters)
        names = ", ".join(value.name for value in values)
        text = f"preset s 1 as s {{ t = /t {name}; }} s() given {{ {given} }} {{ event e({names}) t {{ }} }}"
        [code] = compiled_from({"x.rv": text}, definitions(), lints=False).specifications
        assert code.events[0].type == name


@pytest.mark.parametrize("word", (
    "as", "cancel", "corners", "given", "hosts", "in", "joints", "order", "preset", "role", "safe", "time", "topic",
))  # fmt: skip
def test_old_files_may_use_the_new_words_as_names(word: str) -> None:
    of_parameter = f"event e(int {word}) /t std_msgs/Int32 '{{data:{word}}}' {{ }}"
    of_function = (
        f"f() {{ bool {word}() {{ return true; }} event e() /u std_msgs/Empty '{{}}' {{ {word}(); }} }}"
    )
    event = f"event {word}(int x) /t std_msgs/Int32 '{{data:x}}' {{ {word} = x; }}"
    monitors = load(f"{word}() {{ int {word}; {event} {of_parameter} }} {of_function}")
    monitors.process("/t", message("std_msgs/Int32", data=2), 1)
    assert monitors.value(word, word) == 2


def test_lists_are_read_and_written_in_one_form() -> None:
    assert given_lists.normalise("corners", " 0,0  4 ,0 0, 3.5 ") == "0,0 4,0 0,3.5"
    assert given_lists.normalise("hosts", "10.0.0.7 10.8.0.0/16") == "10.0.0.7/32 10.8.0.0/16"
    assert (given_lists.joints("none"), given_lists.nanoseconds("0.5s")) == ((), 5 * 10**8)


def test_phases_order_specifications_and_statements_do_not_contradict_them() -> None:
    def text(name: str, phase: str) -> str:
        return f"{name}() {phase} {{ event e() /t std_msgs/Empty '{{}}' {{ }} }}\n"

    def names(files: str) -> list[str]:
        return [one.name for one in compiled_from({"x.rv": files}, definitions(), lints=False).specifications]

    written = [("a", "in follows"), ("own", ""), ("b", "in smooths"), ("c", "in stops"), ("d", "in stops")]
    files = "".join(text(*one) for one in written)
    assert names(files) == ["own", "c", "d", "b", "a"]
    assert names(f"{files} order d < c; order a < own;") == ["d", "c", "b", "a", "own"]
    assert any("would come before itself" in one.text for one in refused(f"{files} order a < b;"))
    assert any("no phase `stop`; did you mean `stops`" in one.text for one in refused(text("e", "in stop")))
    plain, phased = (
        compiled_from({"x.rv": text("e", one)}, definitions()).specifications for one in ("", "in stops")
    )
    assert plain[0].identity == phased[0].identity
