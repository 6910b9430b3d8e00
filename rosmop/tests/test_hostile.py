import time
import tracemalloc

import pytest

from rosmop.check.sources import compiled_from
from rosmop.form.findings import SpecificationError
from rosmop.run.engine import MonitorSet
from rosmop.runtime.action_context import BUDGET as BUDGET_SIZE
from rosmop.tests.acting import act, definitions, load, message, refused, refused_action
from rosmop.tests.examples import sample

PATIENCE = 20.0  # seconds of processor time; an endless loop would take longer

BUDGET = "more than 1000000 instructions for one message; is there an endless loop?"
MEMORY = "the values of a specification may hold 16 MiB in total"

SPENT_WHOLE = (
    "for (;;) x++;",
    "f();",
    "f0();",
)  # the other loops get a twentieth of BUDGET, and end the same way

BOMBS = [
    ("while (1);", "", BUDGET),
    ("for (;;) x++;", "", BUDGET),
    ("do { continue; } while (1);", "", BUDGET),
    ("for (int i = 0; i < 100000; i++) for (int j = 0; j < 100000; j++) x++;", "", BUDGET),
    ("f();", "void f() { f(); }", "`f` calls itself endlessly"),
    ("f();", "void f() { g(); } void g() { f(); }", "calls itself endlessly"),
    ("f0();", "".join(f"void f{i}() {{ f{i + 1}(); f{i + 1}(); }} " for i in range(40)) + "void f40() { }", BUDGET),
    ("f(30);", "void f(int n) { if (n > 0) { f(n - 1); f(n - 1); } }", BUDGET),
    ('std::string s = "x"; while (1) s += s;', "", MEMORY),
    ("std::string s(100000000, 'x');", "", MEMORY),
    ("std::string s(1000000, 'x'); for (int i = 0; i < 100000; i++) s[0] = 'y';", "", BUDGET),
    ("std::vector<double> v; while (1) v.push_back(1);", "", BUDGET),
    ("std::vector<double> v(1000000000);", "", MEMORY),
    ("std::vector<double> v; v.resize(4000000000u);", "", MEMORY),
    ("std::vector<double> v(-1);", "", MEMORY),
    ("std::vector<std::vector<double>> v(100, std::vector<double>(100000, 1.0));", "", MEMORY),
    ("std::vector<std::string> v; std::string s(100000, 'x'); while (1) v.push_back(s);", "", MEMORY),
    ("f(1);", "void f(int n) { std::vector<double> v(100000); f(n + 1); }", MEMORY),
    ("while (1) g += g;", 'std::string g = "x";', MEMORY),
    ("while (1) g.push_back(nav_msgs::Odometry());", "std::vector<nav_msgs::Odometry> g;", MEMORY),
    ("char * c = new char[1000000000];", "", MEMORY),
    ("double a[16000000];", "", MEMORY),
    ('while (1) ROS_INFO("aaaaaaaaaaaaaaaaaaaaaaaaaaaaaaaaaaaa");', "", BUDGET),
    ("std_msgs::Int32 m; while (1) PUBLISH(/o, std_msgs/Int32, m);", "", BUDGET),
    ("std::vector<int> v{1}; for (int a : v) v.push_back(a);", "", BUDGET),
    ("std::string s(1000000, 'x'); while (1) s.find(\"y\");", "", BUDGET),
    ("std::string s(1000000, 'x'); while (1) s.find_first_of(\"y\");", "", BUDGET),
]  # fmt: skip


@pytest.mark.parametrize(("body", "before", "text"), BOMBS)
def test_a_bomb_is_a_fault(body: str, before: str, text: str) -> None:
    if text == MEMORY:  # counting memory takes many times as long
        tracemalloc.start()
    most = BUDGET_SIZE if text != BUDGET or body in SPENT_WHOLE else BUDGET_SIZE // 20
    text = text.replace(str(BUDGET_SIZE), str(most))
    began = time.process_time()
    outcome = act(body, before=before, data=3, most=most)
    took = time.process_time() - began
    _, peak = tracemalloc.get_traced_memory()
    tracemalloc.stop()
    assert [text in fault.text for fault in outcome.faults] == [True]
    observes = outcome.faults[0].over and "x++" not in body
    assert outcome.result == ("passed" if observes else "dropped")
    assert took < PATIENCE
    assert peak < 200 << 20


COSTLY = [
    "strcpy(c, s.c_str());",
    "strncpy(c, s.c_str(), 1000000);",
    'strcat(c, "a");',
    'sprintf(c, "%s", "a");',
    'snprintf(c, 100, "a");',
    "strlen(d);",
    "bool b = s == t;",
    "bool b = s + s != t;",
    "bool b = s <= t;",
    "bool b = d == s;",
    "int n = s.compare(t);",
    "int n = strcmp(s.c_str(), t.c_str());",
    "std::string m = std::min(s, t);",
    "s.pop_back();",
    "bool b = v == w;",
    "bool b = g == h;",
    "v.erase(v.begin());",
    "std::sort(texts.begin(), texts.end());",
    'std::string f; f = "x"; ROS_INFO_COND(false, "%s", s.c_str());',
    'char * e = new char[20]; snprintf(e, 20, "%s", s.c_str());',
    'ROS_INFO_STREAM_COND(true, s << "x");',
]
LARGE_VALUES = """std::string s(1000000, 'x'), t(1000000, 'x'); char c[1000001]; char * d;
    std::vector<int> v(500000), w(500000); std::vector<std::string> texts; nav_msgs::OccupancyGrid g, h;
    init() {
        d = new char[1000001]; strcpy(d, s.c_str()); g.data.resize(1000000); h.data.resize(1000000);
        texts.push_back(s); texts.push_back(s);
    }"""


@pytest.mark.parametrize("body", COSTLY)
def test_expensive_operations_are_charged(body: str) -> None:
    text = f"s() {{ {LARGE_VALUES} event e() /t std_msgs/Empty '{{}}' {{ {body} }} }}"
    monitors = load(text)
    outcome = monitors.process("/t", b"", 1)
    assert not outcome.faults, outcome.faults
    if "false" not in body:
        assert BUDGET_SIZE - monitors.monitor("s").context.budget > 5000


def test_short_operations_are_not_charged() -> None:
    body = 'if (s == "turret" || s == t || s < t || v == w) s = t;'
    text = (
        "s() { std::string s, t; std::vector<int> v, w; event e() /t std_msgs/Empty '{}' { " + body + " } }"
    )
    monitors = load(text)
    monitors.process("/t", b"", 1)
    assert monitors.monitor("s").context.budget == BUDGET_SIZE


def test_a_formatted_text_is_charged_before_it_is_made() -> None:
    many = "%s" * 90
    body = f"std::string s(1000000, 'x'); ROS_INFO(\"{many}\"{', s' * 90});"
    streamed = f"std::string s(1000000, 'x'); ROS_INFO_STREAM(s{' << s' * 40});"
    for each in (body, streamed):
        tracemalloc.start()
        outcome = act(each)
        _, peak = tracemalloc.get_traced_memory()
        tracemalloc.stop()
        assert [MEMORY in fault.text for fault in outcome.faults] == [True]
        assert peak < 30 << 20


def test_memory_is_measured_over_all_variables() -> None:
    many = "".join(f"std::string s{i}(1000000, 'x'); " for i in range(20))
    assert MEMORY in act(many).faults[0].text
    freed = "std::string s; for (int i = 0; i < 60; i++) { s = std::string(1000000, 'x'); }"
    assert act(freed).faults == ()


def test_a_value_of_less_than_the_limit_is_held() -> None:
    assert act("std::string s(16000000, 'x'); ROS_INFO(\"%d\", (int) s.size());").log[0].text == "16000000"


GROWN = [
    "s += 'x';", 's += "x";', "s.push_back('x');", 's.append("x");', 's.insert(0, "x");', 's.replace(0, 1, "xy");',
    "s.resize(15000001);", "s[0] = 'y'; s.push_back('x');", "s.erase(0, 1); s.resize(15000001);",
]  # fmt: skip


@pytest.mark.parametrize("change", GROWN)
def test_a_replaced_value_counts_once(change: str) -> None:
    outcome = act(f"std::string s(15000000, 'x'); {change} ROS_INFO(\"%d\", (int) s.size());")
    assert outcome.faults == ()
    assert outcome.log[0].text == "15000001"


def test_a_string_that_grows_beyond_the_limit_is_a_fault() -> None:
    assert MEMORY in act("std::string s(10000000, 'x'); s += std::string(7000000, 'y');").faults[0].text


REFUSED = [
    ("x = " + "(" * 300 + "1" + ")" * 300 + ";", "nested more than 100 deep"),
    ("x = " + "!" * 5000 + "1;", "nested more than 100 deep"),
    ("if (x) " * 3000 + "x = 1;", "nested more than 100 deep"),
    ("{" * 3000 + "}" * 3000, "nested more than 100 deep"),
    ("x = " + "x ? 1 : " * 3000 + "2;", "nested more than 100 deep"),
    ("while (x) " * 30 + "x = 1;", "more than 15 nested loops"),
    ("x = x + 1; " * 40000, "the file has more than 128 Ki characters"),
    ("x = " + "9" * 5000 + ";", "is not a number"),
    ("std::vector<" * 200 + "int" + "> " * 200 + "v;", "nested more than 100 deep"),
]


@pytest.mark.parametrize(("body", "text"), REFUSED)
def test_texts_beyond_the_limits_are_rejected(body: str, text: str) -> None:
    began = time.process_time()
    findings = refused_action(body)
    assert any(text in finding.text for finding in findings)
    assert time.process_time() - began < PATIENCE


DEEP_BUT_RIGHT = [
    "x = " + "(" * 80 + "1" + ")" * 80 + ";",
    "if (x) " * 80 + "x = 1;",
    "x = " + " + ".join(["x"] * 80) + ";",
    "x = " + "x ? 1 : " * 80 + "2;",
    "while (x) " * 14 + "x = 0;",
    "std::vector<int> v(9); x = " + "v[" * 80 + "1" + "]" * 80 + ";",
    "switch (x) {" + "".join(f"case {i}: x++;" for i in range(1000)) + "}",
]


@pytest.mark.parametrize("body", DEEP_BUT_RIGHT)
def test_texts_within_the_limits_run(body: str) -> None:
    assert act(body, data=3).faults == ()


def test_no_string_of_a_specification_becomes_code() -> None:
    text = r"""'); import os; ("\n\\ {0} %% ' \" \x00 b' + v1"""
    outcome = act(
        f"""ROS_INFO("{text.replace('"', chr(92) + '"').replace(chr(92) * 2 + '"', chr(92) + '"')}");"""
    )
    assert outcome.log[0].text.startswith("'); import os; (")


HUGE_COUNTS = [
    ("std_msgs/String", "std::string x", b"\xff\xff\xff\xff"),
    ("std_msgs/ByteMultiArray", "int8_t[] x", b"\0\0\0\0\0\0\0\0\xff\xff\xff\xff"),
    ("sensor_msgs/JointState", "std::string[] x", b"\0" * 12 + b"\0\0\0\0" + b"\xff\xff\xff\xff"),
    ("nav_msgs/Path", "auto x", b"\0" * 12 + b"\0\0\0\0" + b"\xff\xff\xff\x7f"),
]


@pytest.mark.parametrize(("kind", "parameter", "data"), HUGE_COUNTS)
def test_a_count_beyond_the_message_is_a_fault(kind: str, parameter: str, data: bytes) -> None:
    field = {"nav_msgs/Path": "poses", "sensor_msgs/JointState": "name"}.get(kind, "data")
    text = f"a() {{ event e({parameter}) /t {kind} '{{{field}:x}}' {{ auto y = x; }} }}"
    outcome = load(text).process("/t", data, 0)
    assert (outcome.result, len(outcome.faults)) == ("dropped", 1)
    assert "not a message of this type" in outcome.faults[0].text


WALKS = [
    ("sensor_msgs/JointState", "position[1]:x", b"\0" * 16 + (3_000_000).to_bytes(4, "little") + bytes(12_000_000)),
    ("diagnostic_msgs/DiagnosticArray", "status[1].level:x",
     b"\0" * 16 + b"\2\0\0\0" + bytes(13) + (2_000_000).to_bytes(4, "little") + bytes(16_000_017)),
]  # fmt: skip


@pytest.mark.parametrize(("kind", "pattern", "data"), WALKS)
def test_a_walk_over_millions_of_elements_is_charged_before_it_is_made(
    kind: str, pattern: str, data: bytes
) -> None:
    monitors = load(f"a() {{ event e(auto x) /t {kind} '{{{pattern}}}' {{ auto y = x; }} }}")
    took = []
    for at in range(3):  # the minimum, because other processes may disturb the caches
        began = time.process_time()
        outcome = monitors.process("/t", data, at)
        took.append(time.process_time() - began)
    assert min(took) < 0.05
    assert (outcome.result, len(outcome.faults)) == ("passed", 1)
    assert "too many elements precede a field" in outcome.faults[0].text


def test_few_elements_before_a_field_cost_nothing_and_many_their_number() -> None:
    for names, cost in ((50, 0), (500, 500)):
        monitors = load(
            "a() { event e(double x) /t sensor_msgs/JointState '{position[1]:x}' { double y = x; } }"
        )
        data = message("sensor_msgs/JointState", name=["j"] * names, position=[1.0, 2.0])
        spent_on = monitors.monitor("a").context
        assert monitors.process("/t", data, 0).result == "passed"
        assert 1_000_000 - spent_on.budget in range(cost, cost + 20)


def test_an_array_of_too_many_strings_is_a_fault() -> None:
    monitors = load("a() { event e(std::string[] x) /t sensor_msgs/JointState '{name:x}' { auto y = x; } }")
    outcome = monitors.process("/t", b"\0" * 16 + (1_500_000).to_bytes(4, "little") + bytes(6_000_012), 0)
    assert "an array of 1500000 elements; at most 1000000" in outcome.faults[0].text


def test_unreadable_texts_are_rejected_with_a_position() -> None:
    for text in (
        "\0",
        "\x1b[31m",
        "a() { \ud800 }",
        "'" * 1000,
        "/*" * 1000,
        '"' * 999,
        "@" * 999,
        "#" * 10,
        "\ufeff",
    ):
        with pytest.raises(SpecificationError) as caught:
            MonitorSet.of(compiled_from({"x.rv": text}, definitions()))
        assert caught.value.findings[0].position.line >= 1
        assert all(character.isprintable() for character in caught.value.findings[0].text)


HEAD = "a() { event e(int x) /t std_msgs/Int32 '{data:x}' { "
LONG = [
    HEAD + "x = " + "(" * 60000,
    HEAD + "x = " + "(" * 30000 + "1" + ")" * 30000 + "; } }",
    HEAD + "{" * 60000 + "}" * 60000 + "} }",
    HEAD + "x = " + "x+" * 50000 + "1; } }",
    "a() { " + "event " * 20000,
    "/*" * 60000,
    "a() { event e() /t std_msgs/Empty '{}' {} ere: " + "/ " * 40000 + "@match {} }",
    "a() { event e(int x) /t std_msgs/Int32 '{" + "a." * 50000 + "b:x}' {} }",
    "a() { event e(int x) /t std_msgs/Int32 '{" + "a:{" * 30000 + "b:x" + "}" * 30000 + "}' {} }",
    "a() { " + "int a; " * 15000 + "}",
    "a() { " + "void f() { } " * 9000 + "}",
    "a() { event e() /t std_msgs/Empty '{}' {} " + "ere: e @match { } " * 5000 + "x }",
]


@pytest.mark.parametrize("text", sample(LONG, 3), ids=sample(range(len(LONG)), 3))
def test_a_long_text_is_answered_in_time(text: str) -> None:
    began = time.process_time()
    assert refused(text)
    assert time.process_time() - began < PATIENCE
