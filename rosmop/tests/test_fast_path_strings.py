from random import Random

import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from rosmop.fast import wasm_runner
from rosmop.fast.abi import MAX_KEPT, MAX_TEXTS
from rosmop.tests.acting import message
from rosmop.tests.both_ways import BothWays, plain, stamped
from rosmop.tests.examples import examples
from rosmop.tests.reload import replaced

SOME = settings(max_examples=examples(120), suppress_health_check=list(HealthCheck))
LONG = b"0123456789abcdef" * (MAX_KEPT // 16)
TEXTS = (
    b"", b"a", b"abc", b"ab\0c", b"ab\0d", b"\0", b"\xff\xfe", b"\xc3\x28", b"abcdefgh", b"abcdefgi", b"abcdefghi",
    b"x" * 64, b"x" * 65, b"x" * 64 + b"y", LONG[:-1], LONG, LONG + b"z", LONG * 3,
)  # fmt: skip


def kept(
    body: str,
    more: str = "",
    before: str = 'std::string a; std::string b; std::string c = "abc"; int n = 0;',
) -> str:
    return f"""s() {{ {before}
        event e(std::string f, int x) /stamped own/Stamped '{{frame:f, count:x}}' {{ {body} }} {more} }}"""


STATEMENTS = (
    "a = f;", "b = f;", "a = b;", "b = a;", "c = a;", "a = a;", "a = b = f;", 'a = "abc";', "a.clear();", "b = c;",
    "{ std::string t = a; a = b; b = t; }", 'c = n % 2 == 1 ? a : "other";', "c = x > 2 ? f : (n > 3 ? b : a);",
    "f = f;", "n += a.size() + 2 * b.length() + c.empty();", "if (a == f) { n++; }", "if (f != b) { n += 2; }",
    "if (a < b) { n += 3; }", "if (b >= f) { n += 5; }", "if (f <= a || a > c) { n += 7; }",
    'if (c == "abc") { n += 11; }',
    'if (b < "abd") { n += 13; }', "if (a == a) { n += 17; }", 'ROS_INFO("%s|%s|%d", a.c_str(), b.c_str(), n);',
    "std::cout << c << std::endl;", "if (x == 5) { return; }", "if (x == 4) { n = 1 / (x - 4); }",
    "if (x == 3) { DROP; }",
    "if (same(a, f)) { n++; }", "keep(f);", 'keep("lit");', "x = n;", "if (x == 2) { a += \"y\"; }",
    "if (x == 1) { c = a + b; }", "if (a.size() > 2) { n += a[1]; }",
    "for (int i = 0; i < 3; i++) { b = a; a = c; c = b; }",
    "if (n > 50) { f = b; n = 0; }",
)  # fmt: skip
FUNCTIONS = """std::string a; std::string b; std::string c = "abc"; int n = 0;
    bool same(std::string one, std::string other) { return one == other; }
    void keep(const std::string& text) { a = text; if (text == b) { n += 19; } }"""
LOGICS = (
    "", "ptltl: e -> (*) o @violation { n++; c = a; } @validation { b = c; }",
    "fsm: one [ e -> two, o -> one ] two [ e -> one, o -> two ] @two { if (a == c) { b = \"two\"; } } @one { DROP; }",
    "ere: (e | o)* o @match { a = b; __RESET; }",
)  # fmt: skip
OTHER = """t() { int m = 0; std::string own;
    event o(std::string g, std::string[] names) /stamped own/Stamped '{frame:g, names:names}' {
        if (own == g) { m++; } own = g; for (std::string one : names) { if (one == own) { own = one; m += 2; } } } }"""


@SOME
@given(seed=st.integers(0, 1 << 30))
def test_random_programs_of_strings(seed: int) -> None:
    random = Random(seed)  # noqa: S311  draws examples, not keys
    body, other = (" ".join(random.choices(STATEMENTS, k=random.randint(1, 6))) for _ in range(2))
    event = f"event o(std::string f, int x) /stamped own/Stamped '{{frame:f, count:x}}' {{ {other} }}"
    plainly = "event p(int x) /plain own/Plain '{count:x}' { b = a; if (x == 9) { c += \"p\"; } }"
    texts = [kept(body, f"{event} {plainly} {random.choice(LOGICS)}", FUNCTIONS)]
    both = BothWays(
        *texts, *([OTHER] if random.random() < 0.3 else []), on_fault=random.choice(("drop", "pass"))
    )
    few = random.sample(TEXTS, 4)
    for time in range(1, 9):
        both.counting = random.random() < 0.7
        names = tuple(random.choices(few, k=random.randint(0, 3)))
        bodies = [
            stamped(random.choice(few), random.choice((0, 0, 1, 2, 3, 4, 5, 6, 7)), names)
            for _ in range(random.choice((1, 2, 12)))
        ]
        both.check(bodies, "/stamped", time)
        if random.random() < 0.4:
            both.check([plain(random.choice((7, 9)))] * 2, time=time)


@pytest.mark.parametrize("text", TEXTS, ids=lambda text: f"{len(text)} {text[:6]!r}")
def test_every_kind_of_string_is_kept_and_compared(text: bytes) -> None:
    both = BothWays(
        kept(
            'if (a < f) { n++; } if (f == a) { n += 3; } if (a >= c) { n += 5; } a = f; ROS_INFO("%s", a.c_str());'
        )
    )
    for other in TEXTS:
        both.check([stamped(text), stamped(other), stamped(text)], "/stamped")
    assert bool(both.came["together"]) == (len(text) <= MAX_KEPT)


def test_up_to_the_bound_nothing_is_for_the_engine() -> None:
    both = BothWays(kept("if (x == 1) { n += a.size(); } a = f; b = a;"))
    both.check([stamped(LONG[:size]) for size in (0, 1, 7, 1000, MAX_KEPT)], "/stamped")
    assert both.came["together"] == 1
    assert both.state()[:2] == [f"a {LONG!r}", f"b {LONG!r}"]
    both.check([stamped(LONG + b"x"), stamped(b"y")], "/stamped")
    both.check([stamped(b"z")], "/stamped")
    assert both.state()[0] == "a b'z'"
    both.check([stamped(LONG + b"x")], "/stamped")
    before = both.came["together"]
    both.check([stamped(b"z", 1)], "/stamped")
    assert both.came["together"] == before
    assert f"n {MAX_KEPT + 1}" in both.state()


def test_lines_show_the_string_of_their_message() -> None:
    both = BothWays(kept('ROS_INFO("%s %s", a.c_str(), b.c_str()); b = a; a = f; ROS_INFO("%s", b.c_str());'))
    for batch in ([b"one", b"two", b"three"], [b"four"], [b"five", b""]):
        both.check([stamped(frame) for frame in batch], "/stamped")
    assert both.came["together"] == 3
    assert [line.text for line in both.lines] == ["four three", "four", "five four", "five"]


def test_a_fault_in_the_middle_takes_back_what_was_assigned() -> None:
    both = BothWays(
        kept(
            "std::string t = a; a = b; b = t; if (x == 7) { n = 1 / (x - 7); } a = f;",
            "event o(int x) /stamped own/Stamped '{count:x}' { c = b; n = 10 / (x - 6); b = a; }",
        )
    )
    for counts in ((1, 6, 2, 7, 3), (7, 6, 1), (6,), (1, 2)):
        both.check([stamped(b"m%d" % number, count) for number, count in enumerate(counts)], "/stamped")
    assert both.came["fault"] == 5
    assert both.came["together"] > 2


def test_strings_survive_wherever_the_module_is_stopped(monkeypatch: pytest.MonkeyPatch) -> None:
    text = kept("{ std::string t = a; a = b; b = c; c = t; } if (x == 2) { a = f; } n++;")
    for fuel in [*range(3500, 6000, 37), *range(6000, 12000, 331)]:
        monkeypatch.setattr(wasm_runner, "FUEL", fuel)
        both = BothWays(text)
        for time in range(1, 5):
            both.check([stamped(LONG[: 100 * number], number % 4) for number in range(11)], "/stamped", time)


def test_arrays_survive_wherever_the_module_is_stopped(monkeypatch: pytest.MonkeyPatch) -> None:
    text = """s() { std::vector<std::string> a; std::vector<std::string> b; std::vector<double> v; double n = 0;
        event e(std::vector<std::string> names, std::vector<double> at) /s sensor_msgs/JointState
        '{name:names, position:at}' { b = a; if (names.size() != 3) { a = names; }
        if (v.size() != at.size()) { v = at; }
        for (int i = 0; i < v.size(); i++) { v[i] = (v[i] + at[i]) / 2; n += v[i]; } } }"""

    def told(number: int) -> bytes:
        names = [f"joint {number} {each}" for each in range(number % 5)]
        return message("sensor_msgs/JointState", name=names, position=[0.5 * number] * (number // 3))

    for fuel in [*range(3500, 6000, 97), *range(6000, 16000, 997)]:
        monkeypatch.setattr(wasm_runner, "FUEL", fuel)
        both = BothWays(text)
        for time in range(1, 5):
            both.check([told(time + number) for number in range(11)], "/s", time)
        assert both.came["together"]


def test_what_is_too_long_to_keep_is_left_to_the_engine() -> None:
    text = """s() { std::vector<std::string> a; int n = 0; event e(std::vector<std::string> names, int k)
        /s sensor_msgs/JointState '{name:names, header.seq:k}' { if (k == 1) { a = names; } n += a.size(); } }"""
    both = BothWays(text)
    few, long = ["x" * 20] * MAX_TEXTS, ["x" * 60] * MAX_TEXTS
    for names in (few, long, [*few, ""], few):
        both.check([message("sensor_msgs/JointState", name=names, header__seq=1)] * 2, "/s")
        before = both.came["together"]
        both.check([message("sensor_msgs/JointState", name=["y"])] * 2, "/s")
        assert (both.came["together"] > before) == (names is few)


def test_strings_go_to_the_set_that_follows() -> None:
    text = kept("a = f; if (x == 1) { b = f; }")
    both = BothWays(text)
    both.check([stamped(b"one", 1), stamped(b"two\0\xff")], "/stamped")
    both.lane("/stamped")
    following, _ = replaced(
        both.monitors, {"0.rv": text, "1.rv": OTHER}, both.monitors.compiled.messages.definitions, 5
    )
    names = following.interpreter.variables
    values = [names[code] for code in following.monitors[0].code.variables.values()]
    assert values[:3] == [b"two\0\xff", b"one", b"abc"]
