from struct import pack, unpack

import pytest

from rosmop.check.sources import compiled_from
from rosmop.run.engine import MonitorSet
from rosmop.tests.acting import definitions, fields, load, message, refused
from rosmop.tests.both_ways import BothWays, plain
from rosmop.tests.logics.driving import seeded
from rosmop.tests.on_module import on_module

CAP = """cap() given { double vMax = 0.22 m/s in 0..2; float f = 0.1 in 0..1; int n = 3 in -1 .. 5; bool on = true;
    topic command = /cmd_vel; topic other = /o; } {
    int seen;
    safe geometry_msgs/Twist { } on command every 100ms;
    event c(double x, double y) command geometry_msgs/Twist '{linear.x:x, linear.y:y}' when (on) {
        seen = seen + n; y = f; if (!(x <= vMax)) { x = vMax; } }
    event t() every 1s { PUBLISH(other, std_msgs/Bool, said); } std_msgs::Bool said; }"""
FAST = message("geometry_msgs/Twist", linear__x=9.0)
TENTH = unpack("<f", pack("<f", 0.1))[0]


def speeds(monitors: MonitorSet, time: int = 1) -> tuple[float, float]:
    linear = fields("geometry_msgs/Twist", bytes(monitors.judge("/cmd_vel", FAST, time).buffer)).linear
    return linear.x, linear.y


@pytest.mark.parametrize("module", [True, False])
def test_a_value_is_set_between_two_messages_and_the_state_stays(module: bool) -> None:
    compiled = compiled_from({"x.rv": CAP}, definitions())
    monitors = on_module(compiled, "drop") if module else MonitorSet.of(compiled)
    monitors.start(0)
    assert speeds(monitors) == (0.22, TENTH)
    monitors.give({"cap": {"vMax": 1, "n": 5, "f": 0.5}, "unknown": {"vMax": 1}})
    assert (speeds(monitors), monitors.value("cap", "seen")) == ((1.0, 0.5), 8)
    for wrong in (2.1, -0.1, float("nan"), True, "1", None):
        monitors.give({"cap": {"vMax": wrong, "on": 1}})  # type: ignore[dict-item]  # wrong values
        assert speeds(monitors) == (0.22, TENTH)
    monitors.give({"cap": {"on": False}})
    assert speeds(monitors) == (9.0, 0.0)
    assert monitors.value("cap", "seen") == 8 + 6 * 3


def test_values_are_outside_of_the_state() -> None:
    monitors = on_module(compiled_from({"x.rv": CAP}, definitions()), "drop")
    monitors.start(0)
    monitors.give({"cap": {"vMax": 1.5}})
    cap = monitors.monitor("cap")
    assert ({*cap.code.variables}, monitors.has_departed(cap)) == ({"seen", "said"}, False)
    speeds(monitors)
    kept = [(one.names, one.layout, one.base(), one.cells() or None) for one in monitors.kept_groups()]
    after = on_module(compiled_from({"x.rv": CAP}, definitions()), "drop")
    after.recover(kept, {}, 1)
    assert (after.value("cap", "seen"), speeds(after)) == (3, (0.22, TENTH))
    beside = compiled_from({"x.rv": CAP, "y.rv": CAP.replace("cap", "lid").replace("command = /c", "command = /d")},
                           definitions())  # fmt: skip
    succeeding = on_module(beside, "drop")
    succeeding.give({"cap": {"vMax": 1.0}})
    succeeding.succeed(monitors, 2)
    assert (succeeding.value("cap", "seen"), succeeding.began, speeds(succeeding)) == (
        3,
        ("lid",),
        (1.0, TENTH),
    )


def test_the_module_and_the_interpreter_agree_for_all_values() -> None:
    both = BothWays("""s() given { int n = 3 in -9..9; double x = 1 in -2..2; } { double sum;
        event e(int c, double y) /plain own/Plain '{count:c, x:y}' {
            sum += x * c; if (c > n) { return; } y = sum + n; } }""")
    random = seeded(41)
    for _ in range(60):
        values = {"s": {"n": random.randint(-9, 9), "x": random.uniform(-2, 2)}}
        both.monitors.give(values)
        both.interpreter.give(values)
        both.check([plain(random.randint(-9, 9), random.uniform(-3, 3)) for _ in range(6)])
    assert both.came["together"] and both.came["dropped"] and both.came["changed"]


def test_a_topic_renames_events_safe_messages_and_publications() -> None:
    """A state belongs to the text and to its topics, so another topic starts again."""
    given: tuple[dict[str, str], ...] = (
        {},
        {"command": "/base/cmd"},
        {"command": "/cmd_vel", "vMax": "/x"},
        {"other": "/p"},
    )
    all_topics = ({"cap": topics, "lid": {"command": "/x"}} for topics in given)
    sets = [compiled_from({"x.rv": CAP}, definitions(), topics=topics) for topics in all_topics]
    codes = [one.specifications[0] for one in sets]
    assert [code.events[0].topic for code in codes] == ["/cmd_vel", "/base/cmd", "/cmd_vel", "/cmd_vel"]
    assert [code.safes[0].topic for code in codes] == ["/cmd_vel", "/base/cmd", "/cmd_vel", "/cmd_vel"]
    assert [{publication.topic for publication in each.publications} for each in sets] == [
        {"/cmd_vel", "/o"}, {"/base/cmd", "/o"}, {"/cmd_vel", "/o"}, {"/cmd_vel", "/p"},
    ]  # fmt: skip
    identities = [code.identity for code in codes]
    assert identities[0] == identities[2] and len({*identities}) == 3


REFUSED = [
    ("double v = 3 in 0..2;", "the default 3 of `v` is outside of its range 0..2"),
    ("double v = 3;", "`v` needs a range"),
    ("int v = 1.5 in 0..2;", "int cannot hold 1.5"),
    ("unsigned char v = 1 in 0..300;", "cannot hold 300"),
    ("double v = 1e999 in 0..2;", "double cannot hold 1e999"),
    ("bool v = 1 in 0..1;", "write `bool v = true;`"),
    ("double v = x in 0..2;", "write a number, its unit and its range"),
    ("double v = 1 in 2;", "write a number, its unit and its range"),
    ("double v = 1 in 0..2; int v = 1 in 0..2;", "`v` is declared twice"),
    ("topic v = t;", "`t` is not a global name; write `/t`"),
    ("topic v = /t; topic v = /t;", "the topic `v` is given twice"),
    ("v = 1;", "a given is `double name = 0.22 m/s in 0..2;`"),
    ("double v = 1 in 0..2; } { double w = v + 1;", "`v` may change while s runs"),
    (
        "double v = 1 in 0..2; } { double f() { return v; } double w; init() { w = f(); }",
        "`v` may change while s runs",
    ),
    ("double v = 1 in 0..2; } { event x() /x std_msgs/Empty '{}' { v = 1; }", "`v` is const"),
]


@pytest.mark.parametrize(("given", "why"), REFUSED)
def test_invalid_givens_are_refused(given: str, why: str) -> None:
    body = given if "} {" in given else f"{given} }} {{"
    errors = refused(f"s() given {{ {body} event e() /t std_msgs/Empty '{{}}' {{ }} }}")
    assert any(why in error.text for error in errors), errors


def test_another_specification_reads_a_given_constant() -> None:
    reader = "r() { event e(int x) /n std_msgs/Int32 '{data:x}' { x = n; } }"
    monitors = load(CAP, y=reader)
    monitors.give({"cap": {"n": 4}})
    outcome = monitors.process("/n", message("std_msgs/Int32"), 1)
    assert fields("std_msgs/Int32", bytes(outcome.buffer)).data == 4
    assert [
        "may change" in one.text for one in refused(CAP + reader.replace("event", "int m = n; event"))
    ] == [True]
