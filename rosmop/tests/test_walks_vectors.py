"""Vectors that variables keep and actions make: the module does with them what the interpreter does."""

import struct
from random import Random

import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from rosmop.fast import layout, wasm_runner
from rosmop.fast.abi import ROOM
from rosmop.fast.batch_codegen import written
from rosmop.form.components import groups
from rosmop.runtime.values import Values
from rosmop.tests.examples import examples
from rosmop.tests.test_walks import Fed, plain
from rosmop.text.errors import SpecificationError

SOME = settings(max_examples=examples(60), suppress_health_check=list(HealthCheck))
MOST = ROOM // 8
"""Numbers of 64 bits that have room."""

KINDS = ("double", "float", "int", "long", "unsigned int", "int8_t", "uint8_t", "int16_t", "uint64_t", "bool")


def stamped(values: tuple[float, ...] = (), count: int = 0) -> bytes:
    """An `own/Stamped`."""
    body = struct.pack("<I3sIIdh", 3, b"abc", 9, 8, 2.5, count)
    return body + struct.pack(f"<I{len(values)}dBI", len(values), *values, 0, 0)


def kept(body: str, more: str = "", kind: str = "double", before: str = "") -> str:
    """A specification with an event that reads an array and a number; it keeps vectors of a kind, one of doubles."""
    return f"""s() {{ std::vector<{kind}> a; std::vector<{kind}> b = {{1, 2, 3}}; {kind} f[4] = {{4, 5}};
        std::vector<double> d; double n = 0; std::string word = "abc"; std::string text; {before}
        event e(std::vector<double> values, int x) /stamped own/Stamped '{{values:values, count:x}}' {{ {body} }}
        {more} }}"""


STATEMENTS = (
    "a.push_back(x);", "a.push_back(n);", "a = b;", "b = a;", "a = a;", "a = b = a;", "a.clear();", "b.pop_back();",
    "if (!a.empty()) { a.pop_back(); }", "a[0] = x;", "b[x] = 7;", "b.at(1) += 2;", "a.back() = n;", "b.front()++;",
    "f[x % 4] = n;", "f[1] += b[0];", "n = f[x];", "a.resize(x);", "b.resize(b.size() + 2);", "b.resize(2);",
    "if (a.size() > 3) { a.erase(a.begin()); }", "a.erase(a.begin() + x);", "b.erase(b.begin(), b.end() - 1);",
    "b.erase(b.end() - 1);", "a.insert(a.begin(), x);", "b.insert(b.end(), n);", "a.insert(a.begin() + x, 5);",
    "a.erase(a.begin() + 2, a.begin() + x);",
    "a = {}; a.push_back(3);", "b = {1, 2, (int) n};", "for (auto one : a) { n += one; }",
    "for (int i = 0; i < b.size(); i++) { n += b[i] * i; b[i] = i; }", "n += a.size() + 10 * b.size() + d.size();",
    "n = std::accumulate(a.begin(), a.end(), n);", "n = std::accumulate(b.begin() + 1, b.end() - x, 0.5);",
    "d = values;", "d = values; d.push_back(n);", "if (d.size() > 1) { n += d[d.size() - 1]; }",
    "for (auto& one : b) { one += 2; }", "for (auto& one : f) { one = one + x; }",
    "{ auto t = a; a[0] = 9; b = t; }", "{ auto t = a; t.push_back(x); b = t; n += t.size(); }",
    "{ std::vector<double> t; for (int i = 0; i < x; i++) { t.push_back(i); t[0] += i; } n += t.size(); d = t; }",
    "{ std::vector<double> t(x); std::vector<double> u(3, 2.5); t.push_back(u[1]); d = t; d = u; }",
    "{ std::vector<double> t = values; t.insert(t.begin(), 1); n += t[0]; t.clear(); n += t.size() + values.size(); }",
    "{ std::vector<double> t = values; n += t.size(); }", "{ double t[3] = {1.5}; t[x] = 2; n += t[2] + t[0]; }",
    "{ auto t = a; auto u = t; u[0] = 1; n += t[0]; t = u; a = t; }", "if (x == 5) { return; }",
    "if (x == 4) { n = 1 / (x - 4); }", "if (x == 3) { DROP; }", "x = n;", "if (n > 1e6) { n = 0; }",
    "if (a == b) { n++; }", "std::sort(a.begin(), a.end());", "std::reverse(b.begin(), b.end());",
    "if (x == 1) { values[0] = 3; }", "if (x == 6) { values = d; n += values.size(); DROP; }",
    "if (x == 7) { for (auto one : b) { b.push_back(one); if (b.size() > 9) { break; } } }",
    "keep(values);", "n += least(d);", "n += size();", "a.push_back(size());", "b[size()] = 1;", "again();",
    "f[0] = f[1] = 3;", "a[a.size() - 1] = b[b.size() - 1];", 'ROS_INFO("%f %d", n, (int) a.size());',
    "std::cout << b[0] << std::endl;", "d = made();", "d = more(d, x); n += more(d, 2)[0];", "n += made().size();",
    "d = same(d);", "d = more(made(), 3);", "for (auto one : more(d, x)) { n += one; }", "grow(d, x);",
    "grow(values, x);", "{ auto t = made(); grow(t, x); d = t; n += t.size(); }",
    "{ auto t = d; auto u = values; n += exchange(t, u, word); d = u; }",
    "exchange(d, values, text);", "text = name(word); word = text;",
    "values = x > 1 ? d : made();", "n += least(made());",
    "values[x] = n;", "for (auto& one : values) { one += 1; }", "std::sort(values.begin(), values.end());",
    "values.resize(values.size());", "values.pop_back(); values.push_back(x);", "values = d;", "values = values;",
    "{ auto t = values; values[0] = 5; n += t[0]; values = t; }",
    "{ auto t = values; t[0] = 5; values = t; n += values[0]; }",
    "if (more(d, 1) == more(values, 1)) { n++; }", "n += exchange(d, values, word) + exchange(values, d, text);",
    "if (values.size() > 2) { values[1] = values[2]; values[2] = 0; }",
)  # fmt: skip
FUNCTIONS = """
    void keep(const std::vector<double>& given) { d = given; d.push_back(1); }
    double least(std::vector<double> given) {
        double found = 1e9; for (double one : given) { found = std::min(found, one); } return found; }
    int size() { b.push_back(1); if (b.size() > 5) { b = a; } return a.size(); }
    std::vector<double> made() { if (n > 3) { return d; } std::vector<double> t = d; t.push_back(n); return t; }
    std::vector<double> more(std::vector<double> given, int k) {
        given.resize(k % 5); given.push_back(k); return given; }
    std::vector<double> same(std::vector<double> given) { d = {4, 2}; return given; }
    void grow(std::vector<double>& given, int& k) {
        if (k > 1) { given.push_back(k); } k++; if (k > 3) { return; } k += 10; }
    int exchange(std::vector<double>& one, std::vector<double>& other, std::string& s) {
        auto t = one; one = other; other = t; s = s == "abc" ? "x" : "abc"; return t.size(); }
    std::string name(const std::string& s) { if (n > 5) { return "five"; } return s; }
    void again() { std::vector<double> t = d; t.push_back(n); if (t.size() > 4) { t.erase(t.begin()); } d = t; }
"""
LOGICS = (
    "", "ptltl: e -> (*) o @violation { n++; d.push_back(n); } @validation { b = a; }",
    "fsm: one [ e -> two, o -> one ] two [ e -> one, o -> two ]"
    " @two { if (a.size() > 2) { a.clear(); } } @one { DROP; }",
    "ere: (e | o)* o @match { a = b; __RESET; }",
)  # fmt: skip
OTHER = """t() { std::vector<double> own; double m = 0;
    event o(std::vector<double> values) /stamped own/Stamped '{values:values}' {
        own.push_back(values[0]); if (own.size() > 3) { own.erase(own.begin()); } m = own[0]; } }"""


def numbers(random: Random) -> tuple[float, ...]:
    """Some that a message brings."""
    some = (0.0, -0.0, 1.5, -7.25, 300.0, 1e300, float("nan"), float("inf"))
    return tuple(random.choices(some, k=random.choice((0, 1, 2, 3, 9))))


@SOME
@given(seed=st.integers(0, 1 << 30))
def test_random_programs_of_vectors(seed: int) -> None:
    """Assigned, changed, looped over, handed on, dropped, faulted; on two topics, from the engine and back."""
    random = Random(seed)  # noqa: S311  draws examples, not keys
    body, other = (" ".join(random.choices(STATEMENTS, k=random.randint(1, 6))) for _ in range(2))
    event = "event o(std::vector<double> values, int x) /stamped own/Stamped '{values:values, count:x}'"
    event += f" {{ {other} }}"
    plainly = "event p(int x) /plain own/Plain '{count:x}' { a.push_back(x); if (x == 9) { b = {a[0]}; } }"
    texts = [kept(body, f"{event} {plainly} {random.choice(LOGICS)}", random.choice(KINDS), FUNCTIONS)]
    fed = Fed(*texts, *([OTHER] if random.random() < 0.3 else []), on_fault=random.choice(("drop", "pass")))
    few = [numbers(random) for _ in range(3)]
    for time in range(1, 9):
        fed.counting = random.random() < 0.7
        counts = random.choices((0, 1, 2, 3, 4, 5, 6, 7, -1), k=random.choice((1, 2, 12)))
        fed.check([stamped(random.choice(few), count) for count in counts], "/stamped", time)
        if random.random() < 0.4:
            fed.check([plain(random.choice((7, 9)))] * 2, time=time)


TAKEN = (
    "a.push_back(x); n = a.back();", "a = values; n = a.size();", "a = b; a[0] = 1; n = b[0];",
    "b.push_back(1); b.pop_back(); b = a;",
    "a.clear(); a.resize(x); n = a.size(); b.resize(2);", "f[1] = x; f[2] += f[1]; n = f[2];",
    "b.erase(b.begin()); b = {1, 2};",
    "a.insert(a.begin(), x); if (a.size() > 3) { a.erase(a.begin() + 1, a.end()); }",
    "for (double& one : f) { one += x; }", "for (double one : b) { n += one; }",
    "n = std::accumulate(b.begin(), b.end(), 0.0);", "std::vector<double> t; t.push_back(x); t[0]++; n = t[0]; a = t;",
    "std::vector<double> t = values; t.push_back(x); n = t.size() + values.size();",
    "std::vector<double> t(5); std::vector<double> u(x, 2.5); n = t[0] + u.size(); a = u;",
    "double g[3] = {x}; n += g[0] + g[2]; g[1] = n; a = g;",
    "b.push_back(-x); std::sort(b.begin(), b.end()); n = b[1]; std::sort(b.begin() + 1, b.end() - 1);",
    "auto t = b; auto u = t; t.push_back(x); n = u.size(); b = u;",
    "std::reverse(b.begin(), b.end()); if (a == b || b != a) { n++; }",
    "keep(values); n += least(a); again();", "d = made(); n += made().size() + made()[0]; grow(d, x); d = more(d, 3);",
    "d = more(more(d, x), 2); n += exchange(d, d2, word); text = name(word); word = text;", "a = x ? b : d;",
    "values[0] = x; for (double& one : values) { one *= 2; } n = values[1];",
    "values[1] = n; n2 = -9; grow(values, n2); n = n2;",
    "std::sort(values.begin(), values.end()); std::reverse(values.begin(), values.end()); values = values;",
    "values = more(b, 2); std::vector<double> t = values; t[0] = 9; values[1] = t[0];", "a = b = values; n = a.at(0);",
)  # fmt: skip


@pytest.mark.parametrize("body", TAKEN)
def test_nothing_of_that_is_for_the_engine(body: str) -> None:
    """Of what a message that faults nowhere does."""
    fed = Fed(kept(body, before=f"std::vector<double> d2; int n2 = 0; {FUNCTIONS}"))
    for _ in range(3):
        fed.check([stamped((1.5, -2.0, 3.0), count) for count in (1, 2, 3)], "/stamped")
    assert fed.came["together"] == 3
    assert fed.came["passed"] + fed.came["changed"] == 9


BEYOND = (
    "values.push_back(x);", "values[0] = 0.0 / 0.0;", "n += deep(x);",
    "for (auto one : b) { b.push_back(one); if (n++ > 5) { break; } }", "w[0].push_back(x);",
    "n = b[(b = a)[0]];", "t.push_back(word);",
)  # fmt: skip


@pytest.mark.parametrize("body", BEYOND)
def test_what_is_beyond_is_left(body: str) -> None:
    """And comes to what it does in the engine."""
    before = """std::vector<std::vector<double>> w; std::vector<std::string> t;
        int deep(int k) { if (k > 0) { return deep(k - 1); } return k; }"""
    try:
        fed = Fed(kept(f"if (x == 2) {{ {body} }} n = x;", before=before))
    except SpecificationError:
        pytest.fail("means nothing")
    fed.check([stamped((1.5,), count) for count in (1, 2, 3)], "/stamped")
    assert fed.came["together"] == 2


@pytest.mark.parametrize("kind", KINDS)
def test_every_kind_of_number(kind: str) -> None:
    """At its limits, in the module, at home in Python, and back."""
    text = f"""s() {{ std::vector<{kind}> v; {kind} last = 0;
        event e(double x) /plain own/Plain '{{x:x}}' {{ v.push_back(x); last = v.back(); v[0] = v[v.size() / 2];
            if (v.size() > 12) {{ v.clear(); }} }} }}"""
    fed = Fed(text)
    limits = (0.0, -0.0, 1.0, -1.0, 127.0, 255.0, -129.0, 65535.0, 2.0**31, 2.0**32 - 1, 2.0**63, 1e300, 0.1)
    for time in range(3):
        fed.check([plain(x=x) for x in (*limits, float("inf"), float("nan"))], time=time)
        fed.state()
    assert fed.came == {"together": 3, "passed": 45}


@pytest.mark.parametrize("kind", KINDS)
def test_they_are_sorted_and_put_the_other_way_round(kind: str) -> None:
    """Those that are equal stay in their order; where one is no number, it is for the engine."""
    text = kept(
        "a.clear(); for (auto one : values) { a.push_back(one); } b = a; std::sort(a.begin(), a.end());"
        " if (x > 0) { std::sort(b.begin() + x, b.end() - 1); std::reverse(b.begin(), b.end() - x); }"
        " std::reverse(a.begin(), a.end()); n = a[0] * 3;",
        kind=kind,
    )
    random = Random(kind)  # noqa: S311  draws examples, not keys
    some = (0.0, -0.0, 1.5, -7.25, 300.0, -1e300, 1e300, float("inf"), float("-inf"), 2.0**63, -1.0, 255.0)
    fed = Fed(text)
    sizes = (1, 2, 3, 5, 17, 64, 65, 100, 255, 256, 257, 1000)
    for size in sizes:
        few, many = (tuple(random.choices(some, k=size)) for _ in range(2))
        more = tuple(random.uniform(-1000, 1000) for _ in range(size))
        fed.check(
            [stamped(few), stamped(many, min(size - 1, 3)), stamped(more, min(size - 1, 2))], "/stamped"
        )
    assert fed.came == {"together": len(sizes), "passed": 3 * len(sizes)}
    fed.check([stamped((1.0, float("nan"), 0.5, -3.0, 2.0))], "/stamped")
    assert fed.came["together"] == len(sizes) + (kind not in ("double", "float"))


@pytest.mark.parametrize("kind", KINDS)
def test_two_are_compared(kind: str) -> None:
    """By what they hold, whatever it is that holds them; a NaN is like nothing."""
    text = kept(
        "a.clear(); for (auto one : values) { a.push_back(one); } if (a == b) { n++; } if (a != b) { n += 2; }"
        f" d = values; if (x == 1) {{ b = a; }} if (values == d) {{ n += 4; }} std::vector<{kind}> t = a;"
        " if (t != a) { n += 8; } t.push_back(3); if (a == t) { n += 16; }",
        kind=kind,
    )
    fed = Fed(text)
    draws: list[tuple[float, ...]] = [
        (),
        (1.0,),
        (1.0, 2.0),
        (1.0, 2.5),
        (0.0, -0.0),
        (-0.0, 0.0),
        (1.0, 2.0),
    ]
    draws += [(7.0,) * 300, (7.0,) * 299 + (8.0,), (0.0, 2.0**40)]
    fed.check([stamped(one, count) for one in draws for count in (0, 1)], "/stamped")
    fed.check([stamped(one) for one in draws], "/stamped")
    assert fed.came == {"together": 2, "passed": 3 * len(draws)}
    none = float("nan")
    fed.check([stamped((0.0, none), 1), stamped((none, 1.0)), stamped((0.0, none))], "/stamped")
    assert fed.came["together"] == 3


TIMES = """s() { std::vector<ros::Time> v; std::vector<ros::Duration> d; ros::Duration step; ros::Time last; int n = 0;
    std::vector<ros::Time> later(std::vector<ros::Time> given) {
        for (auto& one : given) { one += ros::Duration(1, 500000000); } return given; }
    event e(ros::Time t, int c) /plain own/Plain '{when:t, count:c}' {
        v.push_back(t); if (v.size() > 1) { d.push_back(v[v.size() - 2] - t); }
        if (v.size() > 7) { v.erase(v.begin()); }
        std::sort(v.begin(), v.end()); if (c == 1) { v = later(v); std::reverse(v.begin(), v.end()); } last = v.back();
        std::vector<ros::Time> u(3, t); u[1] += ros::Duration(0, 250000000);
        if (c == 2) { v = u; d.resize(2); step = d[1]; }
        if (u == v) { n++; } if (c == 3) { n = 1 / (n - n); }
        for (auto one : d) { if (one < step) { n += 3; } }
        t = last; } }"""


def test_times_and_durations() -> None:
    """Those that no message can have are the engine's, too: longer ones, and with too many nanoseconds."""
    fed, random = Fed(TIMES), Random(5)  # noqa: S311  draws examples, not keys
    for time in range(20):
        bodies = []
        for _ in range(9):
            seconds = random.choice((5, 6, 2**31, random.randrange(2**16)))
            moment = (seconds, random.choice((0, 7, 10**9 - 1, 10**9, 2**32 - 1)))
            if time > 15:
                moment = (2**32 - random.choice((1, 2, 6)), moment[1])
            body = plain(random.choice((0, 1, 2, 3) if time % 3 == 2 else (0, 1, 2)))
            bodies.append(body[:18] + struct.pack("<II", *moment) + body[26:])
        fed.check(bodies, time=time)
    assert min(fed.came[what] for what in ("fault", "changed", "together")) > 10
    fed = Fed(TIMES)
    for time in range(4):
        fed.check([plain(count) for count in (0, 1, 2, 0, 1)], time=time)
    assert fed.came["together"] == 4


ARRAYS = """s() { int n = 0;
    event e(std::vector<long> t, std::vector<uint8_t> r, int c) /plain own/Plain '{three:t, rest:r, count:c}' {
        n++; t[c] = n; for (auto& one : r) { one += c; }
        if (c == 2) { t = {7, 8, 9}; t[0] = t[2]; std::sort(r.begin(), r.end()); }
        if (c == 1) { t[2] = 6 / (n % 5 - 1); } if (n % 7 == 6) { DROP; } if (n % 7 == 5) { r.push_back(1); }
        c = r.size(); }
    event o(std::vector<long> t, std::vector<uint8_t> r) /plain own/Plain '{three:t, rest:r}' {
        if (r.size() > 1) { r[1] = t[0]; t[1] += r[0]; } } }"""


def test_arrays_of_the_message_are_changed_where_they_stand() -> None:
    """As the engine changes them, also behind another event, before a fault and a drop, and cut after each byte."""
    fed, random = Fed(ARRAYS), Random(3)  # noqa: S311  draws examples, not keys
    for time in range(30):
        fed.check(
            [plain(random.randrange(4), rest=random.randbytes(random.randrange(20))) for _ in range(9)],
            time=time,
        )
    whole = plain(1, rest=b"abcdefg")
    for end in range(len(whole)):
        fed.check([whole, whole[:end], plain(2, rest=b"zyx")])
    assert min(fed.came[what] for what in ("fault", "dropped", "changed", "together")) > 30
    fed = Fed(ARRAYS)
    fed.check([plain(0, rest=bytes(2000))] * 4)
    assert fed.came == {"together": 1, "changed": 4}


def scan(*ranges: int) -> bytes:
    """A `sensor_msgs/LaserScan` with these bits of ranges."""
    return struct.pack(f"<IIII3s7fI{len(ranges)}II", 1, 2, 3, 3, b"abc", *range(7), len(ranges), *ranges, 0)


def test_what_is_no_number_in_an_array_that_is_changed() -> None:
    """It stays as it is; one that is put there, or that Python would change, is for the engine."""
    fed = Fed("""s() { double n = 2; event e(std::vector<float> r, unsigned int q) /scan sensor_msgs/LaserScan
        '{ranges:r, header.seq:q}' { r[0] = n; n++; if (n > 21) { r[1] = r[2]; } } }""")
    one, none, other = 0x3F800000, 0x7FC00123, 0xFF800001
    fed.check([scan(one, one, none), scan(none, 0xFFC00000, one), scan(one, none)] * 5, "/scan")
    assert fed.came == {"together": 1, "changed": 15}
    fed.check([scan(one, one, other), scan(one, 0x80000000, 0), scan(0, 0x7F800001, 0)], "/scan")
    assert fed.came["together"] == 2
    fed.check(
        [scan(one, one, one), scan(one, one, one), scan(one, one, none), scan(one, none, none)], "/scan"
    )
    assert fed.came["together"] == 4


def test_an_array_that_is_changed_and_has_no_room_is_the_engines() -> None:
    """Those that nothing changes are not."""
    for many, walked in ((MOST, 1), (MOST + 1, 2)):
        fed = Fed(kept("if (x > 0) { values[0] = x; } n += values.size();"))
        fed.check([stamped((1.5,) * many, count) for count in (0, 1, 0, 1)], "/stamped")
        assert fed.came == {"together": walked, "passed": 2, "changed": 2}


@pytest.mark.parametrize("body", ["d.push_back(x);", "d.insert(d.begin(), x);", "d.resize(d.size() + 1);"])
def test_what_has_no_room_is_for_the_engine(body: str) -> None:
    """Up to the bound it is not; nor is what gives up one that is beyond it."""
    fed = Fed(
        kept(
            f"if (x == 1) {{ d = values; }} if (x == 2) {{ {body} }} if (x == 3) {{ d.clear(); }}"
            " if (x > 4) { d.pop_back(); }"
        )
    )
    full, more = (1.0,) * MOST, (2.0,) * (MOST + 1)
    fed.check([stamped(full, 1), stamped((), 5), stamped((), 2)], "/stamped")
    assert fed.came["together"] == 1
    fed.check([stamped((), 2), stamped(), stamped((), 0)], "/stamped")
    assert fed.came["together"] == 2
    fed.check([stamped((), 5), stamped((), 5), stamped((), 2)], "/stamped")
    assert fed.came["together"] == 3
    fed.check([stamped(more, 1)], "/stamped")
    assert fed.came["together"] == 3
    fed.check([stamped(more)], "/stamped")
    assert fed.came["together"] == 4
    fed.check([stamped((), 3), stamped((), 2)], "/stamped")
    fed.check([stamped((7.0,), 1), stamped((), 2)], "/stamped")
    assert len(fed.monitors.value("s", "d")) == 2


def test_a_copy_is_another_vector() -> None:
    """What changes afterwards changes one of the two: between variables, local ones, those of a function, messages."""
    fed = Fed(
        kept(
            """a = b; b[0] = x; n = a[0]; std::vector<double> t = a; a[1] = 9; n += 10 * t[1]; t[1] = 8;
            n += 100 * a[1];
            auto u = t; t.push_back(1); n += 1000 * u.size(); t = u; u[0] = 0; b = t; t[2] = 77; d = values;
            d.push_back(first(d, d)); n += 10000 * values.size();""",
            before="double first(std::vector<double> one, std::vector<double> other) { return one[0] + other.size(); }",
        )
    )
    for _ in range(3):
        fed.check([stamped((1.0, 2.0), count) for count in (1, 2, 3)], "/stamped")
    assert fed.came["together"] == 3


def test_a_fault_in_the_middle_takes_back_what_was_changed() -> None:
    """Elements, lengths and what was assigned are those before the message, and then what the engine does."""
    fed = Fed(
        kept(
            "a.push_back(x); b[0] = x; a[0]++; d = values; if (x == 7) { n = 1 / (x - 7); } a = d; f[x] = x;"
            " b.pop_back();",
            "event o(int x) /stamped own/Stamped '{count:x}' { b = {1, 2, 3}; a.clear(); n = 10 / (x - 2); a = b; }",
        )
    )
    for counts in ((1, 2, 3, 7, 3), (7, 2, 1), (2,), (1, 3), (0, 0, 5, 0)):
        fed.check([stamped((float(number),), count) for number, count in enumerate(counts)], "/stamped")
    assert fed.came["fault"] == 6
    assert fed.came["together"] > 4


def test_vectors_survive_wherever_the_module_is_stopped(monkeypatch: pytest.MonkeyPatch) -> None:
    """The message at hand has not begun, or is taken back."""
    text = kept(
        "a.push_back(x); for (double& one : a) { one += 1; } if (a.size() > 9) { a.erase(a.begin()); } b = a; again(); "
        "std::vector<double> t(3, 1.5); t[0] = a[0]; d = t;",
        before=FUNCTIONS,
    )
    for fuel in [*range(300, 3000, 61), *range(3000, 12000, 997)]:
        monkeypatch.setattr(wasm_runner, "FUEL", fuel)
        fed = Fed(text)
        for time in range(1, 4):
            fed.check([stamped((), number % 4) for number in range(11)], "/stamped", time)


@pytest.mark.parametrize(
    "body",
    [
        "b = a;", "a.insert(a.begin() + 5, 1); a.pop_back();", "a.erase(a.begin() + 7); a.push_back(1);",
        "a.resize(0); a.resize(700);", "std::vector<double> t(601); n += t[0];", "auto t = a; t[0] = 1;",
        "std::vector<double> t(601, 1.0); n += t[0];", "n += a.size(); b = {1, 2}; b.clear();",
        "std::sort(a.begin(), a.begin() + 63);", "std::reverse(a.begin() + 1, a.end());", "if (a == b) { n++; }",
        "b = a; if (a != b) { n++; }", "std::sort(a.end() - 64, a.end()); std::sort(a.end(), a.end());",
        "a.erase(a.begin(), a.begin() + 13);",
        "a.erase(a.begin(), a.begin() + 70); a.resize(601);", "keep(a); n += least(a);",
    ],
)  # fmt: skip
def test_it_is_charged_as_in_the_interpreter(body: str) -> None:
    """What is left of the budget for a message is the same number."""
    fed = Fed(
        kept(
            f"if (x == 1) {{ a = values; }} else {{ for (int i = 0; i < 9; i++) {{ {body} }} }}",
            before=FUNCTIONS,
        )
    )
    fed.check([stamped((1.0,) * 700, 1)], "/stamped")
    compiled = fed.monitors.compiled
    found = [group.component for group in groups(compiled.specifications)]
    module = written(compiled.functions, found, Values(compiled.messages), compiled.stamped)
    ((context, address),) = module.budgets.items()
    fed.check([stamped((), 2)], "/stamped")
    assert fed.came == {"together": 2, "passed": 2}
    assert fed.monitors.area is not None
    memory = memoryview(fed.monitors.area.obj).cast("B")
    assert (
        struct.unpack_from("<q", memory, address)[0] == fed.interpreter.interpreter.contexts[context].budget
    )


def test_vectors_go_to_the_set_that_follows() -> None:
    """A set that replaces this one while the module has the state: what stands is what it was, and goes on."""
    text = kept("a.push_back(x); b = a; f[0] += x;")
    fed = Fed(text)
    fed.check([stamped((), 1), stamped((), 2)], "/stamped")
    fed.walker("/stamped")
    following, _ = fed.monitors.replaced(
        {"0.rv": text, "1.rv": OTHER}, fed.monitors.compiled.messages.definitions, 5
    )
    names = following.interpreter.variables
    values = [names[code] for code in following.monitors[0].code.variables.values()]
    assert values[:3] == [[1.0, 2.0], [1.0, 2.0], [7.0, 5.0, 0.0, 0.0]]


def test_an_array_that_is_cut_off_keeps_nobody_elses_bytes() -> None:
    """Cut after each byte, with others behind it; lengths that lie."""
    fed = Fed(kept("b = a; a = values; n = a.size();"))
    whole = stamped((1.5, 2.5, 3.5), 3)
    for end in range(len(whole)):
        fed.check([whole, whole[:end], stamped((4.0,))], "/stamped")
    at = 3 + 4 + 8 + 8 + 2
    for length in (4, 2**29, 2**31, 2**32 - 1, 2**32 - 5):
        fed.check(
            [whole, whole[:at] + struct.pack("<I", length) + whole[at + 4 :], stamped((4.0,))], "/stamped"
        )
    assert fed.came["together"] > 30


def test_more_vectors_than_have_memory_are_for_the_engine(monkeypatch: pytest.MonkeyPatch) -> None:
    """A set whose vectors would take more than all may, has walks for the topics whose vectors have room."""
    monkeypatch.setattr(layout, "MAX_ROOMS", 5 * ROOM)
    event = "event e{0}(int x) /t{0} std_msgs/Int32 '{{data:x}}' {{ v{0}.push_back(x); }}"
    text = "std::vector<int> v0; std::vector<int> v1; std::vector<int> v2;" + "".join(
        map(event.format, range(3))
    )
    fed = Fed(f"s() {{ {text} }}")
    assert [fed.monitors.walker(f"/t{number}") is not None for number in range(3)] == [True, True, False]
    for number in range(3):
        fed.check([struct.pack("<i", 5)], f"/t{number}")
