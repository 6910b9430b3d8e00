"""Specifications begin in the order of C++: constants, first values, `init`."""

import pytest

from rosmop.check.sources import compiled_from
from rosmop.run.engine import MonitorSet
from rosmop.tests.acting import definitions, load, message, refused, shown

EVENT = "event e(int x) %s std_msgs/Int32 '{data:x}' { %s }"
READERS = [
    ("int a; init() { a = z; }", "5"),
    ("int a = z;", "5"),
    ("int a = y;", "0"),  # another's `init` comes after all first values
    ("int a; init() { a = late; }", "6"),
    ("int a = f(); int b = 3; int f() { return b + 1; }", "4"),
    ("int a = f(); std::vector<int> b{3}; int f() { return b.size(); }", "0"),
]


@pytest.mark.parametrize(("before", "value"), READERS)
def test_a_beginning_may_read_what_stands_elsewhere(before: str, value: str) -> None:
    """Before any first value all variables are constants or zero; before any `init` all have their first values."""
    other = "q() { int z = 5; int late = z + 1; int y; init() { y = 6; } " + EVENT % ("/u", "") + "}"
    reader = "s() {" + before + EVENT % ("/t", 'ROS_INFO("%d", a);') + "}"
    monitors = MonitorSet.of(compiled_from({"a.rv": reader, "b.rv": other}, definitions()))
    assert not monitors.start(0).faults
    outcome = monitors.process("/t", message("std_msgs/Int32"), 1)
    assert [line.text for line in outcome.log] == [value]


@pytest.mark.parametrize("before", ["int a = b; int b = 3;", "int a = 2 * b, b = 3;"])
def test_a_first_value_cannot_read_a_variable_that_is_declared_below(before: str) -> None:
    """C++ does not know the name yet; zero in its place would be a surprise."""
    found = refused("s() {" + before + EVENT % ("/t", "") + "}")
    assert [finding.text for finding in found] == ["`b` is declared below; move its declaration up"]


def test_what_faults_in_its_first_values_does_not_run_its_init() -> None:
    """It has no state that `init` could go on from; the others begin all the same."""
    text = (
        'a() { int n; int m = 1 / n; init() { ROS_INFO("a"); } ' + EVENT % ("/t", "") + "} "
        'b() { init() { ROS_INFO("b"); } ' + EVENT % ("/u", "") + "}"
    )
    monitors = MonitorSet.of(compiled_from({"x.rv": text}, definitions()))
    outcome = monitors.start(0)
    assert [fault.text for fault in outcome.faults] == ["division by zero"]
    assert [line.text for line in outcome.log] == ["b"]
    assert [monitor.broken for monitor in monitors.monitors] == [True, False]


DECLARED = [
    ("bool ok(true);", "ok", "1"),
    ("double y(M_PI);", "(int) y", "3"),
    ("const int N = 3; std::vector<int> v(N);", "(int) v.size()", "3"),
    ("std::vector<int> v(3, -1), w(v);", "w[2]", "-1"),
    ("unsigned u(std_msgs::Byte::X); ", None, "has no constant `X`"),
    ("constexpr int N = 3; int q[N];", "(int) q.size()", "3"),
    ("constexpr double D = 2.5;", "(int) (D * 2)", "5"),
    ("const auto N = 3; int q[N];", "(int) q.size()", "3"),
    ('auto t = "abc";', "(int) t.size()", "3"),
    ("auto n = f(); int f() { return 1; }", None, "`auto` is for"),
    ("int f(); int g() { return f(); } int f() { return 4; }", "g()", "4"),
    ("int f(int a); int f(int a) { return a + 1; }", "f(4)", "5"),
    ("int f(void) { return 6; }", "f()", "6"),
    ("int f(int) { return 6; }", None, "give the parameter a name"),
    ("inline int f(int a) { return a; } static inline int g() { return 7; }", "g()", "7"),
    ("int n; void init() { n = 8; }", "n", "8"),
    ("int n; void init(void) { n = 9; }", "n", "9"),
    ("int n; init(void) { n = 9; }", "n", "9"),
]


@pytest.mark.parametrize(("before", "expression", "value"), DECLARED)
def test_declarations_of_cpp(before: str, expression: str | None, value: str) -> None:
    """Initial values in parentheses, constants, prototypes, `void` and `inline` are read as C++ reads them."""
    if expression is None:
        assert value in refused("s() {" + before + EVENT % ("/t", "") + "}")[0].text
    else:
        assert shown(expression, conversion="%d", before=before) == value


def test_a_fault_behind_a_call_is_told_where_the_call_stands() -> None:
    """And not where the function ended that was called before it in the same statement."""
    text = """s() { int n;
    int f(int a) {
        return a;
    }
    void keep(int a, sensor_msgs::JointState state) { n = a; }
    event e(int seq) /t sensor_msgs/JointState '{header.seq:seq}' {
        keep(f(1), MESSAGE);
    } }"""
    (fault,) = load(text).process("/t", bytes(4), 0).faults
    assert fault.position.line == 7
