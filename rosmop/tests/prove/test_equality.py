from collections import Counter
from collections.abc import Mapping
from pathlib import Path

import pytest

from rosmop.prove.equality import EQUAL, IN_PYTHON, LEFT, findings_of
from rosmop.tests.prove.module_mutants import FAULTY, compiled, event, faulty, faulty_event
from roswire.definitions import Definitions
from roswire.standard import standard_definitions

ROOT = Path(__file__).parents[3]
MONITORS = ROOT / "monitors"
ASSURANCE = ROOT / "docs" / "dev" / "assurance.md"
PRESETS = sorted(MONITORS.glob("guards/*.rv"))


def answers(text: str, known: Definitions | None = None, patience: float = 600) -> dict[str, str]:
    return {finding.event: finding.answer for finding in findings_of(compiled(text, known), patience)}


UNDECIDED = "not decided in time"
BEHIND = "not loop-free: a field comes after strings or arrays in an array"
SHIPPED = {
    "goals": {"goals.goal": IN_PYTHON, "goals.cancel": IN_PYTHON, "goals.result": IN_PYTHON},
    "logging": {
        "logging.batteryState": EQUAL, "logging.position": EQUAL, "logging.turretMovement": BEHIND,
        "logging.shot": EQUAL,
    },
    "obstacle_avoidance": {
        "obstacleAvoidance.speed": EQUAL, "obstacleAvoidance.scan": EQUAL,
        "obstacleAvoidance.drive": IN_PYTHON,
    },
    "safe_triggering": {"safeTrigger.checkPosition": BEHIND, "safeTrigger.safeTrigger": EQUAL},
    "safe_zone": {"safeZone.odometry": EQUAL, "safeZone.gps": EQUAL, "safeZone.drive": EQUAL},
}  # fmt: skip


@pytest.mark.nightly
@pytest.mark.parametrize("name", SHIPPED)
def test_shipped_specifications(name: str) -> None:
    """All events of a module are proved, except loops over arrays; each other event has a reason."""
    trigger = MONITORS / "msg" / "landshark_msgs" / "PaintballTrigger.msg"
    own = Definitions.from_files({"landshark_msgs/PaintballTrigger.msg": trigger.read_text()})
    assert answers((MONITORS / f"{name}.rv").read_text(), standard_definitions().merge(own)) == SHIPPED[name]


def test_no_shipped_specification_is_left_out() -> None:
    assert {path.stem for path in MONITORS.glob("*.rv")} == set(SHIPPED)


def row_of(preset: str, found: Mapping[str, str]) -> str:
    proved = [f"`{name}`" for name, answer in found.items() if answer == EQUAL]
    others: dict[str, list[str]] = {}
    for one, answer in found.items():
        if answer != EQUAL:
            others.setdefault(answer, []).append(f"`{one}`")
    reasons = "; ".join(f"{', '.join(events)}: {answer}" for answer, events in others.items())
    return " ".join(f"| `{preset}` | {', '.join(proved)} | {reasons} |".split())


@pytest.mark.nightly
@pytest.mark.parametrize("path", PRESETS, ids=lambda path: str(path.stem))
def test_the_page_has_what_is_proved_of_each_preset(path: Path) -> None:
    """Where the page says that z3 does not decide, it tries only for a short time again."""
    rows = ASSURANCE.read_text().splitlines()
    patience = (
        600 if any(row.startswith(f"| `{path.stem}` ") and UNDECIDED not in row for row in rows) else 30
    )
    found = answers(path.read_text(), patience=patience)
    assert row_of(path.stem, {name.partition(".")[2]: answer for name, answer in found.items()}) in rows


def test_the_page_has_a_row_for_each_preset() -> None:
    rows = (
        ASSURANCE.read_text()
        .partition("| preset | proved | not proved |")[2]
        .partition("\n\n")[0]
        .splitlines()
    )
    assert [row.split("`")[1] for row in rows[2:]] == [path.stem for path in PRESETS]


PROVED = {
    "guards, fields that are written, a drop": event(
        "if (x < 3) { return; } if (y > 2.5) { y = -y; } x = n + 7; n++;",
        "int x, double y", "count:x, x:y", "uint8_t n = 0;",
    ),
    "conversions at the limits": event(
        "a = y; b = y; c = x; d = c; e = a; x = y;", "long x, double y", "three[0]:x, x:y",
        "int8_t a = 0; unsigned long b = 0; float c = 0; double d = 0; uint16_t e = 0;",
    ),
    "a service": "s() { bool open = false; event e(bool wish) service /mode std_srvs/SetBool request '{data:wish}' {"
    " if (open) { return; } open = wish; wish = !wish; } }",
    "rounding": event("y = floor(y) + trunc(fabs(y)) - rint(y) + ceil(y);", "double y", "x:y"),
    "signs": event("if (!isnan(y)) { y = copysign(2.5, y); } else { y = copysign(1.0, -2.5); }", "double y", "x:y"),
    "times": event(
        "last = t; t.sec = 7; if (t.nsec > 5 && t > last) { n++; }",
        "ros::Time t", "when:t", "ros::Time last; int n = 0;",
    ),
    "helper functions, and what they cannot go on with": event(
        "n = f(x, 7); x = n;", "int x", "count:x",
        'int n = 0; int f(int a, int b) { if (a > 3) { ROS_INFO("x"); } n += a; return a > 2 ? b : a << 1; }',
    ),
    "output": event('ROS_INFO("%d %f", x, y); y = 3;', "int x, double y", "count:x, x:y"),
    "output that is not due": event('n++; ROS_INFO_THROTTLE(10.0, "%d", n);', "int x", "count:x", "int n = 0;"),
    "an element of an array": event(
        "n = three[x] + three.size();", "std::vector<long> three, int x", "three:three, count:x", "long n = 0;"
    ),
    "a string": """s() { int n = 0;
        event e(std::string f) /stamped own/Stamped '{frame:f}' when (f == "base_link") { n += f.size(); } }""",
    "a stop": """s() { int n = 0; safe own/Plain { count: 5, x: 0.5 } on /plain every 100ms;
        event e(double y) /plain own/Plain '{x:y}' { if (!(y <= 3)) { STOP; n++; if (n == 7) { return; } }
        y = -y; } }""",
    "a stop that keeps the stamp": """s() { safe std_msgs/Header { frame_id: "base" } on /h every 100ms;
        event e(int n) /h std_msgs/Header '{seq:n}' { if (n % 3 == 0) { STOP; } } }""",
    "functions of the library, and the age of an event": event(
        "if (age(e) < 1 || !seen(e)) { y = clamp(hypot(sin(y), cos(n)), -n, n); }", "double y", "x:y", "double n = 0;"
    ),
    "a time as seconds": event("d = t.toSec();", "ros::Time t", "when:t", "double d = 0;"),
    "names of nodes that are kept and compared": """s() { std::string last; double at = 0; int n = 0;
        event e() /plain own/Plain '{}' { std::string node = caller(e) == "" ? "a node" : caller(e);
        if (last == "" || last == node) { last = node; at = ros::Time::now().toSec(); } else { n++; return; } } }""",
    "whether an earlier event altered the message": event(
        "if (altered(e)) { n++; y = 0; }", "double y", "x:y", "int n = 0;"
    ),
    "what is left": event(
        "n++; if (y > 3) { told.linear.x = y; PUBLISH(/told, geometry_msgs/Twist, told); }",
        "double y", "x:y", "geometry_msgs::Twist told; int n = 0;",
    ),
    "lines in their order": event(
        'ROS_INFO("%d %f", x, y); ROS_INFO("%d", b); ROS_WARN("%d", x);', "int x, float y, bool b",
        "count:x, y:y, on:b",
    ),
    "a loop that ends early, goes on early, and calls a function with a loop": event(
        "for (int i = 0; i < three.size(); i++) { if (three[i] == 7) { break; } if (three[i] < 0) { continue; }"
        " n += sum(three[i] & 7) + i; if (n > 90) { return; } }",
        "std::vector<long> three", "three:three",
        "long n = 0; long sum(long most) { long all = 0; for (long i = 1; i <= most; i++) { all += i; } return all; }",
    ),
    "the least of an array, and a constant array": event(
        "double least = INFINITY; for (int i = 0; i < three.size(); i++) { double v = three[i] + OFFSETS[i & 1];"
        " if (v < least) { least = v; } } d = least; if (!(d > y)) { y = 0; }",
        "std::vector<long> three, double y", "three:three, x:y",
        "const double OFFSETS[] = {0.5, -0.5}; double d = 0;",
    ),
    "an array that is kept": """s() { std::vector<float> last; int n = 0;
        event e(float[] values) /scan sensor_msgs/LaserScan '{ranges:values}' { n = 0;
        for (int i = 0; i < values.size(); i++) { if (i < last.size() && values[i] == last[i]) { n++; } }
        last = values; } }""",
    "a string that is kept": """s() { std::string last;
        event e(std::string f) /stamped own/Stamped '{frame:f}' { last = f; } }""",
    "a string that is put out": """s() { event e(std::string f) /stamped own/Stamped '{frame:f}' {
        ROS_INFO("from %s", f.c_str()); } }""",
}  # fmt: skip


@pytest.mark.nightly
@pytest.mark.parametrize("name", PROVED)
def test_the_language_is_proved(name: str) -> None:
    assert answers(PROVED[name]) == {"s.e": EQUAL}


UNPROVED = {
    "not loop-free: it has a loop over an array": event(
        "for (long one : three) { n += one; }", "std::vector<long> three", "three:three", "long n = 0;"
    ),
    "not loop-free: a loop changes the message or prints": event(
        'for (int i = 0; i < x; i++) { ROS_INFO("%d", i); }', "int x", "count:x"
    ),
    "uses the sign of a NaN": event("y = copysign(1.0, y);", "double y", "x:y"),
    "uses a constant string or array, or one that is kept": event(
        'if (last == "x") { x = 0; }', "int x", "count:x", "std::string last;"
    ),
    "uses a variable of type std::vector<std::string>": event(
        "if (n > seen.size()) { return; } n++;",
        "double y",
        "x:y",
        "std::vector<std::string> seen; int n = 0;",
    ),
    IN_PYTHON: event("y = exp(y);", "double y", "x:y"),
}


@pytest.mark.nightly
@pytest.mark.parametrize("answer", UNPROVED)
def test_an_unproved_answer_says_why(answer: str) -> None:
    assert answers(UNPROVED[answer]) == {"s.e": answer}


def test_without_time_nothing_is_proved() -> None:
    (found,) = findings_of(compiled(PROVED["conversions at the limits"]), patience=0)
    assert (found.answer, found.differs) == (UNDECIDED, False)


@pytest.mark.nightly
@pytest.mark.parametrize(
    ("name", "every", "times"),
    [
        ("fields, variables, a drop", 9, 3),
        ("output, and what the module leaves", 23, 3),
        ("names that are kept, and seconds", 8, 2),
    ],
)
def test_wrong_modules_are_found(name: str, every: int, times: int) -> None:
    told = Counter(answer for _, answer in faulty(FAULTY[name], every=every))
    assert {*told} - {LEFT} == {EQUAL, "not equal"}
    assert told["not equal"] > times * told[EQUAL]


@pytest.mark.nightly
def test_wrong_loops_are_found() -> None:
    """A sample of the 535 mutants of an event with a loop: runs show five of nine."""
    code = compiled((MONITORS / "guards" / "sensor.rv").read_text(), standard_definitions())
    found = Counter(answer for _, answer in faulty_event(code, "sense", 66))
    assert found["not equal"] == 5, found
