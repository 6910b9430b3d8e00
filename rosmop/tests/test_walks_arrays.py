"""Messages with arrays of any length that are made, kept, changed and published: the module does what the interpreter
does.
"""

import struct
from collections.abc import Sequence
from random import Random

import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from rosmop.fast import wasm_runner
from rosmop.fast.abi import ROOM
from rosmop.fast.layout import HEAP
from rosmop.tests.examples import examples
from rosmop.tests.random_specifications import definitions
from rosmop.tests.test_walks import Fed, frames, plain

SOME = settings(max_examples=examples(60), suppress_health_check=list(HealthCheck))
NUMBERS = (0.0, -0.0, 1.5, -7.25, 300.0, 1e30)
STRANGE = (float("nan"), float("inf"), 1e300)
DOUBLES, FLOATS = (0x7FF0000000000001, 0xFFF8000000000123), (0x7F800001, 0xFFC00123)


def row(  # noqa: PLR0917  the fields that differ
    values: Sequence[float] = (), count: int = 0, name: bytes = b"abc", few: Sequence[float] = (),
    times: Sequence[int] = (), bits: bytes = b"\x01\x00",
) -> bytes:  # fmt: skip
    """An `own/Row`."""
    body = (
        struct.pack("<II", 7, len(name))
        + name
        + struct.pack(f"<I{len(values)}dh", len(values), *values, count)
    )
    body += struct.pack(f"<I{len(few)}fI", len(few), *few, 3) + b"xyz" + struct.pack("<I", len(bits)) + bits
    body += struct.pack(f"<I{len(times)}I", len(times) // 2, *times) + struct.pack(
        "<I2i3d", 1, -3, 5, 1, 2, 3
    )
    return body + struct.pack("<I2qd", 2, -(2**63), 9, 2.5)


def of_rows(body: str, more: str = "", before: str = "") -> str:
    """A specification with an event on rows, which keeps two of them."""
    return f"""s() {{ own::Row last; own::Row told; double n = 0; std::vector<double> v = {{1, 2}}; std::string word;
        {before} {FUNCTIONS}
        event e(std::vector<double> values, int x, std::string s) /row own/Row
        '{{values:values, count:x, name:s}}' {{ {body} }} {more} }}"""


FUNCTIONS = """
    void say(const own::Row& r) { PUBLISH(/said, own/Row, r); n += r.values.size(); }
    double sum(const own::Row& r) { double all = 0; for (double one : r.values) { all += one; } return all; }
    void keep(const own::Row& r) { last = r; last.values.push_back(9); }
    std::vector<double> of(const own::Row& r) { auto t = r.values; last.few.clear(); return t; }
    void again() { own::Row r; r.values.push_back(n); r.few.push_back(2); told.values = r.values; r.values[0] = 4; }
"""
STATEMENTS = (
    "last = MESSAGE;", "told = last;", "last = told;", "PUBLISH(/a, own/Row, MESSAGE);", "PUBLISH(/a, own/Row, last);",
    "PUBLISH(/b, own/Row, told);", "{ own::Row m = MESSAGE; m.count = n; PUBLISH(/a, own/Row, m); last = m; }",
    "last.values[x] = n;", "last.values.push_back(x);", "told.values[0] += 2;", "last.values.clear();",
    "told.values = values;", "told.values = v;", "v = last.values;", "last.values = {1, n, 3};", "n += last.values[x];",
    "n += last.values.size() + 10 * told.values.size();", "for (auto one : last.values) { n += one; }",
    "if (!last.values.empty()) { last.values.pop_back(); }", "last.values.resize(x);", "told.values.resize(5);",
    "if (last.values.size() > 2) { last.values.erase(last.values.begin() + 1); }",
    "told.values.insert(told.values.begin() + x, n);", "std::sort(last.values.begin(), last.values.end());",
    "std::reverse(told.values.begin(), told.values.end());", "last.few.push_back(n); last.bytes.push_back(x);",
    "last.bits.push_back(x); last.bits[0] = !last.bits[0];",
    "last.times.push_back(ros::Time(x, 5)); n += last.times.size();",
    "last.times[0] = ros::Time::now();", "told.gaps = last.gaps; told.gaps.push_back(ros::Duration(x, 7));",
    "n = std::accumulate(last.values.begin(), last.values.end(), n);", "if (last.values == told.values) { n++; }",
    "if (last.values != values) { n += 2; }", "values[0] = 3;", "x = n;", "if (x == 3) { DROP; }",
    "if (x == 5) { return; }",
    "if (x == 4) { n = 1 / (x - 4); }", "say(last);", "say(told);", "n += sum(last);", "keep(told);", "v = of(told);",
    "told.values = of(told);", "again();", "told.three[x] = 4; last.three = told.three;", "s = \"other\";",
    "if (x == 2) { s = word; } word = last.name;", "last.name = s; told.name = word;",
    "{ own::Row m; for (int i = 0; i < x; i++) { m.values.push_back(i); m.few.push_back(-i); } say(m); told = m; }",
    "{ own::Row m = last; m.values.push_back(1); own::Row k = m; m.values[0] = 7; say(k); say(m); last = k; }",
    "{ own::Row m = told; told.values.push_back(4); m.values = told.values; m.values.back() = 1;"
    " say(m); n += m.count; }",
    "{ auto t = last.values; last.values.push_back(n); t.push_back(3); last.values = t; n += t.size(); }",
    "{ auto t = told.values; if (!told.values.empty()) { told.values[0] = -5; } n += t.size() ? t[0] : 1; }",
    "{ own::Row m; m.values = values; m.count = x; PUBLISH(/a, own/Row, m); PUBLISH(/a, own/Row, last);"
    " m.values.clear(); PUBLISH(/a, own/Row, m); }", "for (double one : values) { told.values.push_back(one * 2); }",
    "for (auto& one : told.values) { one += x; }", "for (double one : last.values) { last.values.push_back(one);"
    " if (last.values.size() > 9) { break; } }", "for (double one : told.values) { told.values[0] = x; n += one; }",
    "n += MESSAGE.values.size() + MESSAGE.few.size();", "v.push_back(n); if (v.size() > 4) { v.clear(); }",
    "told.values = std::vector<double>(x, 2.5); told.few = std::vector<float>(2);", "if (n > 1e6) { n = 0; }",
    'ROS_INFO("%f %d", n, (int) last.values.size());', "std::cout << last.values[0] << std::endl;",
    "told.whole = last.whole; told.whole.push_back(x); n += told.whole[0];", "n = last.values[0] = x;",
)  # fmt: skip
PLAIN = """event p(int x) /plain own/Plain '{count:x}' {
    if (x == 9) { n += sin(x); last.values.push_back(sin(n)); } told.values.push_back(x);
    PUBLISH(/p, own/Row, told); }"""


@SOME
@given(seed=st.integers(0, 1 << 30))
def test_random_programs_of_messages_with_arrays(seed: int) -> None:
    """Copied, changed, published, handed on, dropped, faulted; on two topics, from the engine and back."""
    random = Random(seed)  # noqa: S311  draws examples, not keys
    body, other = (" ".join(random.choices(STATEMENTS, k=random.randint(1, 6))) for _ in range(2))
    event = "event o(double one, int x, std::vector<double> values, std::string s) /row own/Row"
    event += f" '{{values[1]:one, count:x, values:values, name:s}}' {{ {other} }}"
    if random.random() < 0.5:
        event = event.replace("double one, ", "").replace("values[1]:one, ", "")
    else:
        event = event.replace(", std::vector<double> values", "").replace(", values:values", "").replace(
            other, "one = n; last = MESSAGE; PUBLISH(/c, own/Row, MESSAGE);")  # fmt: skip
    fed = Fed(of_rows(body, f"{event} {PLAIN}"), on_fault=random.choice(("drop", "pass")))
    some = NUMBERS if random.random() < 0.7 else (*NUMBERS, *STRANGE)
    for time in range(1, 8):
        fed.publishing = random.random() < 0.8
        bodies = []
        for count in random.choices((0, 1, 2, 3, 4, 5, -1), k=random.choice((1, 3, 12))):
            values, few = (random.choices(some, k=random.choice((0, 1, 2, 3, 9))) for _ in range(2))
            few = [one if one != 1e300 else 2.0 for one in few]
            bodies.append(
                row(values, count, random.choice((b"abc", b"")), few, [1, 2] * random.choice((0, 1, 3)))
            )
        fed.check(bodies, "/row", time)
        if random.random() < 0.4:
            fed.check([plain(random.choice((7, 9)))] * 2, time=time)


TAKEN = (
    "PUBLISH(/a, own/Row, MESSAGE); own::Row m = MESSAGE; m.values[0] = x; PUBLISH(/a, own/Row, m);",
    "told = last; last = MESSAGE; last.values.push_back(x); if (last.values == told.values) { n++; }",
    "own::Row m; for (double one : values) { m.values.push_back(one * 2); m.few.push_back(one); }"
    " PUBLISH(/a, own/Row, m);",
    "last.values = values; last.values.resize(2); last.few.clear(); v = last.values; PUBLISH(/a, own/Row, last);",
    "told.values = v; told.values.insert(told.values.begin(), n); told.values.erase(told.values.begin() + 1);"
    " std::sort(told.values.begin(), told.values.end()); for (auto& one : told.values) { one += 1; } again();",
    "say(last); keep(told); n += sum(told); last.bits.push_back(x); last.times.push_back(ros::Time::now());",
    "x = 3; values[0] = n; last = MESSAGE; n += last.values[0]; PUBLISH(/a, own/Row, MESSAGE);",
)  # fmt: skip


@pytest.mark.parametrize("body", TAKEN)
def test_nothing_of_that_is_for_the_engine(body: str) -> None:
    """Of what a message that faults nowhere does."""
    fed = Fed(of_rows(body))
    for time in range(3):
        fed.check(
            [row((1.5, -2.0, 3.0), count, few=[2.5, float("nan")]) for count in (1, 2, 3)], "/row", time
        )
    assert fed.came["together"] == 3
    assert fed.came["passed"] + fed.came["changed"] == 9


def test_what_has_several_encodings_is_published_in_the_engines() -> None:
    """Truths that are no bit, times with too many nanoseconds, signalling NaNs, in arrays."""
    fed = Fed(
        of_rows(
            "PUBLISH(/a, own/Row, MESSAGE); told = MESSAGE; told.values = values; PUBLISH(/b, own/Row, told);"
        )
    )
    doubles = [struct.unpack("<d", struct.pack("<Q", bits))[0] for bits in DOUBLES]
    usual = row((1.0, 2.0), few=(1.0, 2.0), times=(1, 999_999_999))
    at = usual.index(struct.pack("<2f", 1.0, 2.0))
    strange = [usual[:at] + struct.pack("<I", bits) + usual[at + 4 :] for bits in FLOATS]
    strange += [row(doubles), row((1.0,), bits=b"\x02\x01\xff"), row((1.0,), times=(1, 10**9))]
    for body in strange:
        fed.check([usual, body, usual, body], "/row")
    assert fed.came["published together"] > 16


def test_messages_that_are_cut_or_lie() -> None:
    """After each byte, with bytes behind them, with lengths that are not true: nothing is read behind the message."""
    fed = Fed(of_rows("last = MESSAGE; PUBLISH(/a, own/Row, MESSAGE); last.values.push_back(1);"))
    body = row((1.0, 2.0), 3, b"x", (1.0,), (1, 2))
    for end in range(len(body)):
        fed.check([body, body[:end], body], "/row")
    for at in range(0, len(body) - 4, 3):
        for lie in (3, 2**31, 2**32 - 1):
            fed.check(
                [body, body[:at] + struct.pack("<I", lie) + body[at + 4 :], body, body + b"more"], "/row"
            )


def test_as_many_elements_as_have_room() -> None:
    """Kept, made and published: what has no room is the engine's, and whoever looks at that."""
    body = """if (x == 1) { last = MESSAGE; } if (x == 2) { n += last.values.size(); } if (x == 3) { told = last; }
        if (x == 4) { PUBLISH(/a, own/Row, MESSAGE); } if (x == 5) { own::Row m = last; m.values.push_back(1);
        n += m.values.size(); PUBLISH(/a, own/Row, m); } if (x == 6) { last.values.push_back(n); n = last.values[0]; }
        if (x == 7) { PUBLISH(/b, own/Row, last); } if (x == 8) { last.values.clear(); }
        if (x == 9) { own::Row m = MESSAGE; std::sort(m.values.begin(), m.values.end()); n += m.values[0]; }"""
    fed = Fed(of_rows(body))
    most = ROOM // 8
    for size in (3, most - 1, most, most + 1, 8 * most - 16, 9 * most):
        values = [float(number % 7) for number in range(size)]
        fed.check([row(values, 1), row((), 2), row((), 2)], "/row")
        fed.check([row((1.0,), look) for look in (0, 2, 3, 7, 5, 6, 0, 2)], "/row")
        fed.check([row(values, look) for look in (0, 4, 9, 9, 4)], "/row")
        fed.check([row((), 8), row((), 2), row((), 0)], "/row")
    assert fed.came["together"] > 16
    assert fed.came["published together"] > 6


def test_more_than_the_heap_has_room_for() -> None:
    """Of one message, and of many that come together."""
    fed = Fed(
        of_rows("for (int i = 0; i < x; i++) { own::Row m = MESSAGE; m.values.push_back(i); last = m; }")
    )
    values = [1.0] * 900
    for times in (1, 20, 35, 36, 60, 200):
        assert HEAP == 512 << 10
        fed.check([row(values, times)] * 30, "/row")
    many = Fed(of_rows("PUBLISH(/a, own/Row, MESSAGE);"))
    many.check([row([2.0] * 900)] * 200, "/row")
    assert many.came["published together"] > 150


def test_without_fuel_the_message_at_hand_is_as_if_it_had_not_come(monkeypatch: pytest.MonkeyPatch) -> None:
    """Wherever it ends: what is kept is as it was, and the engine publishes all of that message."""
    body = """for (int i = 0; i < 5; i++) { last.values.push_back(i); told = last; told.values[0] = i; say(told); }
        if (last.values.size() > 40) { last.values.erase(last.values.begin(), last.values.begin() + 20); }"""
    together = 0
    for fuel in range(4000, 30000, 1200):
        monkeypatch.setattr(wasm_runner, "FUEL", fuel)
        fed = Fed(of_rows(body))
        fed.check([row((1.0,), number) for number in range(12)], "/row")
        together += fed.came["published together"]
    assert together > 100


def test_what_is_kept_goes_on_in_a_set_that_replaces_another() -> None:
    """Arrays that specifications see of each other, whichever of module and engine takes the next one."""
    first = of_rows("last = MESSAGE; last.values.push_back(x);", PLAIN)
    second = "b() { event e(int x) /row own/Row '{count:x}' { if (x == 2) { told = last; told.few.push_back(1); } } }"
    fed = Fed(first, second)
    for number in range(4):
        fed.check([row((1.0,), number), row((2.0, 3.0), 2)], "/row")
        fed.check([plain(9), plain(1)])
    before = fed.state()
    following, _ = fed.monitors.replaced({"0.rv": first, "1.rv": second}, definitions(), 5)
    names = following.interpreter.variables
    kept = [
        f"{name} {names.get(code)!r}"
        for one in following.monitors
        for name, code in one.code.variables.items()
    ]
    assert set(kept) <= set(before)
    assert fed.came["together"] >= 8


def test_an_array_costs_what_it_costs_in_the_engine() -> None:
    """Copies of long arrays until the budget ends: a fault there, none before."""
    fed = Fed(
        of_rows("for (int i = 0; i < x; i++) { own::Row m = last; n += m.values.size(); } last = MESSAGE;")
    )
    values = [1.0] * 1000
    for times in (1, 5000, 7600, 7900, 8200, 20000):
        fed.check([row(values, 1), row(values, times), row(values, 1)], "/row")
    assert fed.came["fault"] > 0
    assert fed.came["together"] > 6


def test_two_arrays_that_grow_in_turn() -> None:
    """Neither is written over the other, however often they move."""
    fed = Fed(
        of_rows(
            "own::Row m; for (int i = 0; i < x; i++) { m.values.push_back(i); m.whole.push_back(-i);"
            " last.values.push_back(i); last.whole.push_back(2 * i); } PUBLISH(/a, own/Row, m);"
            " PUBLISH(/a, own/Row, last); if (last.values.size() > 300) { last.values.clear(); }"
        )
    )
    for time in range(3):
        fed.check([row((), count) for count in (3, 20, 100, 7)], "/row", time)
    assert fed.came["together"] == 3


def test_what_is_kept_outlives_the_walk() -> None:
    """Of as much as a variable has room for; what is longer is left, as the next walk writes where it stood."""
    fed = Fed(of_rows("if (x == 1) { last = MESSAGE; } if (x == 2) { PUBLISH(/a, own/Row, MESSAGE); }"))
    walker, area = fed.walker("/row"), fed.monitors.area
    assert area is not None
    for size in (ROOM // 8, ROOM // 8 + 1):
        kept, other = row([3.0] * size, 1), row([4.0] * 4000, 2)
        prepared = walker.prepare(loud=False, told=(), published=(True,))
        for body in (kept, other):
            given = frames([body])
            area[: len(given)] = given
            walked = walker.walk(area[: len(given)], 0, 0, [], 1, prepared)
            if walked is not None and not walked.position:
                assert size > ROOM // 8
                fed.monitors.process("/row", body, 1)
            fed.interpreter.process("/row", bytearray(body), 1)
        fed.check([row((), 0)], "/row")
