import struct
from collections import Counter
from pathlib import Path
from random import Random

import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from rosmop.check.sources import compiled_from
from rosmop.fast import wasm_runner
from rosmop.fast.abi import AREA, MAX_TEXTS
from rosmop.fast.batch_codegen import MAX_EFFECTS
from rosmop.fast.memory_layout import LINES
from rosmop.fast.wasm_runner import BEGINNING
from rosmop.form.findings import SpecificationError
from rosmop.run.fast_path import Tried
from rosmop.run.outcomes import MessageSender, Outcome
from rosmop.runtime.wire import Buffer
from rosmop.tests.acting import message
from rosmop.tests.both_ways import STAMPED, BothWays, event, frames, plain, stamped, state_of
from rosmop.tests.examples import examples
from rosmop.tests.on_module import on_module
from rosmop.tests.random_messages import RandomMessages, cuts, lies
from rosmop.tests.random_specifications import Messages, Specifications, definitions
from rosmop.tests.reload import replaced
from rosmop.tests.transcripts import Case, cases, table

FEW = settings(max_examples=examples(90), suppress_health_check=list(HealthCheck))
PROGRAMS = Path(__file__).parent / "programs.txt"

# The same results as the interpreter


@FEW
@given(seed=st.integers(0, 1 << 30), wild=st.lists(st.binary(max_size=80), max_size=4))
def test_random_specifications_and_messages(seed: int, wild: list[bytes]) -> None:
    """Margins of comparisons are also the same, if they are recorded."""
    try:
        both = BothWays(
            *Specifications(seed).texts(), on_fault=("drop", "pass")[seed % 2], margins=seed % 4 > 1
        )
    except SpecificationError:
        return  # the random text is not a valid specification
    messages = Messages(seed)
    for number in range(4):
        traffic = messages.traffic()
        both.counting = bool(seed + number & 2)
        both.check([*traffic.bodies(), *wild], traffic.topic, number)


def test_the_random_messages_reach_every_outcome() -> None:
    came: Counter[str] = Counter()
    for seed in range(24):
        try:
            both = BothWays(*Specifications(seed).texts())
        except SpecificationError:
            continue
        messages = Messages(seed)
        for traffic in (messages.traffic() for _ in range(6)):
            both.check(list(traffic.bodies()), traffic.topic)
        came += both.came
    found = ("fault", "dropped", "changed", "passed", "together")
    assert min(came[what] for what in found) > 3


def test_only_changes_faults_and_large_messages_reach_the_engine(monkeypatch: pytest.MonkeyPatch) -> None:
    both = BothWays("""s() { int n = 0; int m = 0;
        event a(int c) /plain own/Plain '{count:c}' { n++; if (c == 3) { c = 4; } }
        event b(int kind, int x) /plain own/Plain '{kind:kind, three[0]:x}' when (kind == 1) { m = 10 / (n - 5); } }""")
    asked = []
    process = both.monitors.process

    def counted(
        topic: str, buffer: Buffer, time_ns: int, sender: MessageSender, tried: Tried = ""
    ) -> Outcome:
        asked.append(bytes(buffer))
        return process(topic, buffer, time_ns, sender, tried=tried)

    monkeypatch.setattr(both.monitors, "process", counted)
    told, engine = (
        [plain(1), plain(4), plain(6, kind=1)],
        [plain(3), plain(5, kind=1), plain(rest=bytes(AREA))],
    )
    outcomes = [both.monitors.judge("/plain", body, 7) for body in (*told, *engine)]
    assert asked == engine
    assert [outcome.events for outcome in outcomes] == [
        ("s.a",), ("s.a",), ("s.a", "s.b"), ("s.a",), ("s.a", "s.b"), ("s.a",)
    ]  # fmt: skip


EXPRESSIONS = (
    "x % 7", "-x / 3", "x << 33", "(unsigned int) x >> 1", "~x", "abs(x)", "(int8_t) x", "(uint16_t) x", "(int) y",
    "(uint8_t) y", "(unsigned long) y", "(float) x", "(long) y * x", "x ? y : 1", "x == y", "x && y", "!x || y < 0",
    "std::max(x, 7)", "std::min(y, 0.5)", "(x += 2) + x++", "(unsigned int) x < 5u", "x / (x - x)", "y / 0", "x ^ 5L",
    "1000 / (100 / (x | 1))", "std::min(x, std::max(3, std::min(x, 9)))", "sqrt(y)", "floor(y) - ceil(y)", "trunc(y)",
    "fabs(y)", "sin(y)", "isnan(y)", "std::isinf(y)", "isfinite((float) y)", "rint(y)", "nearbyint(y)", "fmin(x, y)",
    "fmax(y, x)", "copysign(x, y)", "fminf(x, y)", "sqrtf(y)", "floorf(y)", "rintf((float) y)", "isnan(0 / y)",
)  # fmt: skip


@pytest.mark.parametrize("expression", EXPRESSIONS)
def test_expressions_at_the_limits(expression: str) -> None:
    before = "double d = 0; long n = 0; float f = 0;"
    both = BothWays(
        event(f"d = {expression}; n = d; f = d; x = n;", "int x, double y", "count:x, x:y", before)
    )
    for x in (0, 1, -1, 7, 2**31 - 1, -(2**31)):
        both.check(
            [
                plain(x, y)
                for y in (0.0, -0.0, 0.5, -2.5, 300.0, 1e300, -1e300, float("inf"), float("nan"), 2.0**63)
            ]
        )
    assert both.came["together"] or expression in {"sin(y)", "x / (x - x)"}


@table(PROGRAMS)
def test_each_program_does_the_same_in_the_module_and_the_interpreter(case: Case) -> None:
    """Messages are also cut after each byte, and have false lengths.

    The module handles messages of programs marked `module`, and none of those marked `engine`.
    """
    both, random = BothWays(case.text), Random(case.beside)  # noqa: S311  draws examples, not keys
    ((topic, kind),) = both.monitors.topics.items()
    messages = RandomMessages(definitions(), random)
    for number in range(examples(240)):
        both.check(messages.read(kind), topic, 1_700_000_000_123_456_789 + number)
    whole = messages.whole(kind)[:400]
    both.check(cuts(whole), topic, 1_700_000_001_000_000_000)
    both.check(lies(whole, random), topic, 1_700_000_001_000_000_000)
    assert (("module" if both.came["together"] else "engine"),) == case.expected


LEFT = [case for case in cases(PROGRAMS) if case.section == "Left to the engine now and then"]
ALWAYS_LEFT = (
    "numbers that are published",
    "a message that is read",
    "the whole message",
    "a vector that is made",
)


@pytest.mark.parametrize("case", LEFT, ids=lambda case: case.beside)
def test_messages_that_do_not_need_the_engine_are_the_modules(case: Case) -> None:
    both = BothWays(case.text)
    both.check([stamped(count=1)] * 3, "/stamped")
    assert both.came == {"together": 1, "passed": 3}
    if case.beside in ALWAYS_LEFT:
        assert BothWays(case.text.replace("if (c > 2)", "")).monitors.lane("/stamped") is None


def test_an_array_with_too_many_strings_is_left_to_the_engine() -> None:
    both = BothWays(next(case.text for case in cases(PROGRAMS) if case.beside == "arrays of strings"))
    many = message("sensor_msgs/JointState", name=["b"] * (MAX_TEXTS + 1), position=[0.5] * (MAX_TEXTS + 1))
    few = message("sensor_msgs/JointState", name=["b"], position=[0.5])
    both.check([few, many, few], "/s")
    assert both.came["together"] == 2


def test_more_output_than_the_module_stores_is_printed() -> None:
    both = BothWays(event('ROS_INFO("%d %d", count, n); n++;'))
    both.check([plain(number) for number in range(LINES // 24 + 50)])
    assert both.came["together"] >= 2


def test_output_without_end_is_a_fault() -> None:
    both = BothWays(event('while (true) { ROS_INFO("%1000d", count); }'))
    both.check([plain(1)])
    assert +both.came == {"fault": 1}


def test_throttled_output_is_printed_when_it_is_due() -> None:
    both = BothWays(event('n++; ROS_INFO_THROTTLE(2, "%d", n);'))
    second = 1_000_000_000
    for time in (
        0,
        1,
        second,
        2 * second - 1,
        2 * second,
        3 * second,
        5 * second,
        4 * second,
        4 * second + 1,
    ):
        both.check([plain()] * 2, time=1_700_000_000 * second + time)
    assert both.came["together"] == 9


@pytest.mark.parametrize("text", ["", "a", "abc", "map_frame", "a name of thirty bytes exactly", "x" * 64])
def test_strings_are_compared_to_the_last_byte(text: str) -> None:
    pattern = text.replace('"', "")
    both = BothWays(f"""s() {{ int n = 0; event a() /stamped own/Stamped '{{frame:"{pattern}"}}' {{ n++; }}
        event b(std::string f) /stamped own/Stamped '{{frame:f}}' {{ if (f != "{pattern}") {{ n += 100; }} }} }}""")
    others = {text, text + "x", text[:-1], text[:-1] + "y", "z" + text[1:], text[::-1]}
    for other in sorted(others):
        raw = other.encode()
        both.check([struct.pack("<I", len(raw)) + raw + STAMPED[7:]] * 2, "/stamped")
    assert both.came["together"] == len(others)


def test_seconds_of_every_size_are_rounded_once() -> None:
    both = BothWays(
        "s() { double d = 0; event e(ros::Time t) /plain own/Plain '{when:t}' { d = t.toSec(); } }"
    )
    for seconds in (0, 1, 9_007_199, 9_007_200, 1_700_000_000, 2**32 - 1):
        for nanoseconds in (0, 1, 3, 254_740_991, 254_740_993, 499_999_999, 999_999_999):
            body = plain()
            both.check([body[:18] + struct.pack("<II", seconds, nanoseconds) + body[26:]])
    assert both.came["together"] == 42


def test_seconds_that_overflow_wrap() -> None:
    both = BothWays("s() { long n = 0; event e(ros::Time t) /plain own/Plain '{when:t}' { n = t.sec; } }")
    both.check([plain()[:18] + struct.pack("<II", 2**32 - 1, 2**32 - 1) + plain()[26:]])
    assert both.state() == ["n 3"]


# Hostile bytes, bounds


def test_a_fault_in_the_middle_of_a_batch_undoes_its_message_only() -> None:
    both = BothWays(
        """a() { int n = 0; event e(int count, double x) /plain own/Plain '{count:count, x:x}' { n += count; x = n; }
               fsm: one [ e -> two ] two [ e -> one ] @fail { } }
        b() { int m = 1; event e(int count, double x) /plain own/Plain '{count:count, x:x}' {
               m = m * 3; x = x + m; m = 100 / (count - 7); } }"""
    )
    both.check([plain(count) for count in (1, 2, 7, 3, 7, 7, 4)])
    assert both.came["fault"] == 3
    assert both.came["together"] == 3


def test_a_message_without_fuel_is_left_to_the_engine(monkeypatch: pytest.MonkeyPatch) -> None:
    text = event("for (int i = 0; i < 50; i++) { n += i; } count = n;")
    for fuel in range(2000, 12000, 500):
        monkeypatch.setattr(wasm_runner, "FUEL", fuel)
        BothWays(text).check([plain(number) for number in range(20)])


def test_fuel_lasts_for_many_calls_and_is_renewed(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(wasm_runner, "FUEL", 1000)
    both = BothWays(event("n++;"))
    lane, one = both.lane(), frames([plain()])
    assert both.monitors.area is not None
    view = both.monitors.area[: len(one)]
    view[:] = one
    prepared = lane.prepare(loud=False, told=())
    left = [left for _ in range(200) if (left := lane.process_batch(view, 0, 0, [], 1, prepared))]
    assert 2 < len(left) < 100
    assert {walked.position for walked in left} == {0}
    assert both.state() == [f"n {200 - len(left)}"]


def test_only_the_beginning_of_a_long_message_is_copied() -> None:
    picture = bytes(range(256)) * (BEGINNING // 128)
    both = BothWays(event("if (count == 3) { return; } count = count + 1; n++;"))
    both.check([plain(1, rest=picture), plain(2), plain(3, rest=picture), plain(4, rest=picture), plain(5)])
    assert both.came["together"] == 1
    further = BothWays(event("n += r; count = n;", "int r, int count", "rest[600]:r, count:count"))
    for together in (1, 2):
        further.check([plain(1, rest=picture[:1000]), plain(3, rest=picture[:1000])] * 2)
        assert further.came["together"] == together
    behind = BothWays("s() { int n = 0; event e(int r) /plain own/Plain '{rest[9000]:r}' { n += r; } }")
    assert behind.monitors.area is not None
    for together in (1, 1, 2):
        behind.check([plain(rest=picture), plain(rest=picture)])
        assert behind.came["together"] == together
    assert behind.state() == ["n 240"]


def test_large_batches_are_processed_in_pieces(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("rosmop.fast.wasm_runner.FUEL", 10**9)
    both = BothWays("""one() { int n = 0; event e(int count, double x) /plain own/Plain '{count:count, x:x}' {
        n++; if (count % 2) { x = n; } } }
        two() { event e(float y) /plain own/Plain '{y:y}' when (y == 0) { y = 1; } }""")
    many = [plain(number) for number in range(MAX_EFFECTS + AREA // 20)]
    both.check(many)
    assert both.came["together"] == 1
    assert [*both.lane().take_events()] == [len(many)] * 2


# State


def test_the_module_and_the_engine_share_variables() -> None:
    first = """a() { int n = 0; double d = 0; bool b = false; unsigned int u = 1; long l = -1; float f = 0; ros::Time t;
        event e(int count) /plain own/Plain '{count:count}' {
            n += count; d = n / 3.0; b = n % 2; u = u * 5; l = l * 7; f = d; t = ros::Time(1, 2); }
        event said() /stamped own/Stamped '{}' { ROS_INFO("%d", n); } }"""
    second = (
        "b() { int seen = 0; event e(double x) /plain own/Plain '{x:x}' { seen = n; x = d; l = l + seen; } }"
    )
    both = BothWays(first, second)
    for number in range(4):
        both.check([plain(number)] * 3)
        both.check([STAMPED], "/stamped")
    both.check([plain(9)] * 2)
    before = both.state()
    following, _ = replaced(both.monitors, {"0.rv": first, "1.rv": second}, definitions(), 5)
    assert state_of(following) == before


def test_events_and_drops_are_counted() -> None:
    both = BothWays("""s() { event a(int kind) /plain own/Plain '{kind:kind}' { }
        event b(int count) /plain own/Plain '{count:count}' when (count > 1) { if (count > 2) { return; } } }""")
    lane, view = both.lane(), memoryview(bytearray(frames(plain(number) for number in (1, 2, 3, 3, 1, 4))))
    pieces: list[memoryview] = []
    walked = lane.process_batch(view, 0, 0, pieces, 1, lane.prepare(loud=False, told=()))
    size = len(plain()) + 4
    assert walked is not None
    assert (walked.position, walked.run, [*walked.dropped]) == (6 * size, 6 * size, [0, 3])
    assert [bytes(piece) for piece in pieces] == [bytes(view[: 2 * size]), bytes(view[4 * size : 5 * size])]
    assert [[*lane.take_events()] for _ in range(2)] == [[6, 4], [0, 0]]


# The remaining messages, and their time


@pytest.mark.parametrize(
    ("body", "has"),
    [
        ("n = count;", True),
        ('if (count > 3) { ROS_WARN("high"); }', True),
        ("count = n; n++;", True),
        ("if (n > 2) { return; }", True),
        ("for (int i = 0; i < 3; i++) { n++; }", True),
        ('ROS_INFO("each");', True),
        ('std::string s = "x" + std::to_string(count);', False),
        ("n = down(3);", False),
        ("v.push_back(1);", False),
        ("if (count > 3) { std::reverse(v.begin(), v.end()); }", True),
        ("n = exp(count);", False),
    ],
)
def test_a_topic_whose_messages_all_need_the_engine_has_no_lane(body: str, has: bool) -> None:
    before = "int n = 0; std::vector<int> v; int down(int i) { return i ? down(i - 1) : 0; }"
    both = BothWays(event(body, before=before))
    assert (both.monitors.lane("/plain") is not None) == has


def test_lanes_wait_until_a_monitor_has_begun() -> None:
    monitors = on_module(
        compiled_from({"x.rv": "hold s() { event e() /plain own/Plain '{}' { } }"}, definitions())
    )
    monitors.start(0, restarted=True)
    lane = monitors.lane("/plain")
    assert lane is not None
    answers = [monitors.lane_ready(lane, 1)]
    monitors.process("/plain", plain(), 1)
    answers.append(monitors.lane_ready(lane, 1))
    monitors.resume("s")
    monitors.process("/plain", plain(), 1)
    answers.append(monitors.lane_ready(lane, 1))
    assert answers == [False, False, True]


def test_lanes_wait_while_something_is_due() -> None:
    both = BothWays(
        "s() { int n = 0; event e() /plain own/Plain '{}' { n++; } event t() every 1ms { n = n * 10; } }"
    )
    both.check([plain()] * 3, time=1000)
    assert both.monitors.lane_ready(both.lane(), 1000)
    assert not both.monitors.lane_ready(both.lane(), 2_000_000)
    both.check([plain()], time=1_500_000)
    assert both.state() == ["n 31"]


CLOCKED = (
    "tfsm: a [ e -> b, o -> a ] b [ e -> a, o -> b, timeout 3ms -> c ] c [ default a, timeout 1ms -> a ]"
    " @c { n++; } @timeout { m++; }",
    "tfsm: a [ e -> b, o -> a ] b [ default a ] @timeout { n++; }",
    "pattern: globally: e causes o within 3ms @violation { n++; __RESET; }",
    "pattern: after e until o: some e within 2ms @violation { n++; __RESET; } @validation { m++; }",
    "pattern: globally: e requires o within 2ms @violation { n++; __RESET; }",
    "pattern: globally: o forbids e within 2ms @violation { n++; __RESET; }",
    "pattern: until o: no e within 2ms @violation { n++; __RESET; } @validation { m++; }",
    "mtl: e => once[0,2ms] o @violation { n++; __RESET; }",
    "mtl: e => !o since[1ms,inf] e @violation { n++; }",
    "mtl: e => previously[1ms,inf] o @violation { m++; }",
    "mtl: historically[0,3ms] (e => previously o) @violation { n++; } @validation { m++; }",
)


@pytest.mark.parametrize("text", CLOCKED)
def test_properties_with_clocks_do_the_same_in_the_module(text: str) -> None:
    """Covers explanations over far more steps than are kept.

    If a message sets an earlier deadline, that deadline precedes the next message.
    """
    both = BothWays(
        f"""s() {{ int n = 0; int m = 0; int k = 0;
        event e(int c) /plain own/Plain '{{count:c}}' when (c % 3 == 0) {{ if (c == 9) {{ k = 1 / (k - k); }} }}
        event o(int c) /plain own/Plain '{{count:c}}' when (c % 3 == 1) {{ k++; }} {text} }}"""
    )
    random, time = Random(3), 0  # noqa: S311  draws examples, not keys
    for number in range(150):
        time += random.choice((0, 300_000, 900_000, 2_000_000, 4_000_000, 1_100_000_000))
        quiet = number // 40 % 2
        bodies = [
            plain(random.choice((0, 1) if number % 9 else (0, 1, 2, 9)))
            for _ in range(random.choice((1, 1, 2, 40 * quiet + 1)))
        ]
        both.check(bodies, time=time)
    assert both.came["together"] > 10
    assert both.told == both.interpreted
    assert len(both.told) > 5
    assert all(one.why for one in both.told)


HANDLED = (
    "ere: a* (b | epsilon) @fail { n++; if (k > 40) { DROP; } __RESET; } @match { m = m * 3 + n; }",
    "ptltl: a -> (*) b @violation { m++; if (n > 9) { return; } DROP; n += 10; } @validation { n = n / 2; }",
    "fsm: one [ a -> two, b -> one ] two [ a -> one, b -> three ] three [ default one ]"
    " @two { } @three { m = 100 / (k % 7); } @one { if (m > 3) { v.push_back(1); m = 0; } }",
    "ere: (a | b)* a b @match { DROP; __RESET; } ltl: [] (a => o (a or b)) @violation { n++; __RESET; }"
    " fsm: s [ a -> t, default s ] t [ b -> s, default t ] @t { m += n; }"
    " @s { for (int i = 0; i < 3; i++) { n ^= i; } }",
)


@pytest.mark.parametrize("text", HANDLED)
def test_handlers_run_where_verdicts_are_only_counted(text: str) -> None:
    both = BothWays(
        f"""s() {{ int n = 0; int m = 0; int k = 0; std::vector<int> v;
        event a(int c) /plain own/Plain '{{count:c}}' when (c % 2 == 0) {{ k++; if (c == 8) {{ k = 1 / (k - k); }} }}
        event b(int c) /plain own/Plain '{{count:c}}' when (c % 3 == 0) {{ k++; c = k; }} {text} }}
        t() {{ int seen = 0; event all(double x) /plain own/Plain '{{x:x}}' {{ seen++; x = seen; }} }}"""
    )
    random, counted = Random(5), 0  # noqa: S311  draws examples, not keys
    for time in range(1, 40):
        both.counting = time % 3 > 0
        both.check(
            [plain(random.choice((0, 1, 2, 3, 4, 6, 8) if time % 5 else (2, 3))) for _ in range(30)],
            time=time,
        )
        counted += both.counts.total()
    assert counted > 100
    assert both.came["together"] > 60
    assert both.came["dropped"] > 5 or "DROP" not in text
    assert all(one.why for one in both.told)


def test_a_deadline_set_by_the_module_is_known_at_once() -> None:
    both = BothWays("""s() { event a() /plain own/Plain '{count:1}' { } event b() /plain own/Plain '{count:2}' { }
        event tick() every 1s { } pattern: globally: a causes b within 1ms @violation { } }""")
    both.check([plain(1)], time=5_000_000)
    both.check([plain(2)], time=5_000_500)
    both.check([plain(3), plain(1), plain(3)], time=5_000_700)
    assert both.came["together"] == 3
    assert both.monitors.next_due == 6_000_001
    assert [one.timer for one in both.monitors.advance(6_000_001)] == []
    assert both.monitors.next_due == 6_000_701
    assert [one.timer for one in both.monitors.advance(6_000_701)] == ["s.deadline"]


def test_a_disabled_monitor_is_not_in_the_lane() -> None:
    both = BothWays(event("n = count;"), event("n++;").replace("s()", "t()"))
    for one in (both.monitors, both.interpreter):
        one.switch({"s": False}, 5)
    both.check([plain(7)] * 3)
    assert both.state() == ["n 0", "n 3"]
    both.monitors.switch({"t": False}, 5)
    assert both.monitors.lane("/plain") is None


def test_a_batch_stops_before_a_change_or_drop_to_report() -> None:
    both = BothWays(event("count = 7; if (n > 2) { return; } n++;"))
    lane, given = both.lane(), frames([plain()] * 6)
    assert both.monitors.area is not None
    view, size = both.monitors.area[: len(given)], len(plain()) + 4
    view[:] = given
    walked = lane.process_batch(view, 0, 0, [], 5, lane.prepare(loud=True, told=[False]))
    assert walked is not None
    assert (bytes(view), walked.position) == (given, 0)
    prepared = lane.prepare(loud=False, told=[True])
    walked = lane.process_batch(view, 0, 0, [], 5, prepared)
    assert walked is not None
    assert bytes(view) == frames([plain(7)] * 3 + [plain()] * 3)
    assert (walked.position, prepared.changed) == (3 * size, {1: 3})
    assert both.state() == ["n 3"]
