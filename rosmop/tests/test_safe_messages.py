import itertools
from itertools import product
from typing import Any

import pytest

from rosmop.check.sources import compiled_from
from rosmop.run.engine import MonitorSet
from rosmop.run.execution import OnFault
from rosmop.run.outcomes import Outcome
from rosmop.tests.acting import definitions, fields, load, message, refused
from rosmop.tests.both_ways import BothWays, plain
from rosmop.tests.examples import examples
from rosmop.tests.logics.driving import ABC, compiled, seeded
from rosmop.tests.random_specifications import definitions as random_definitions
from rosmop.tests.test_suppression import FORMULAS, Timed, projected, timed

TENTH = 10**8
TWIST = "geometry_msgs/TwistStamped"
SAFE = f'safe {TWIST} {{header:{{frame_id:"base"}}, twist.angular.z:0.5}} on /cmd_vel every 100ms;'
SCAN = "event scan(std::vector<float> r) /scan sensor_msgs/LaserScan '{ranges:r}' { near = r[0]; }"
DRIVE = (
    f"event drive(double v) /cmd_vel {TWIST} '{{twist.linear.x:v}}' {{ if (near < 1) {{ STOP; v = 7; }} }}"
)
NEAR, EMPTY = (message("sensor_msgs/LaserScan", ranges=ranges) for ranges in ([0.5], []))


def guard(*members: str, head: str = "guard()") -> str:
    return f"{head} {{ double near = 9; {' '.join(members or (SAFE, SCAN, DRIVE))} }}"


def command(speed: float = 1.0, frame: str = "joy", turn: float = 0.0) -> bytes:
    return message(TWIST, header__seq=7, header__stamp__sec=3, header__frame_id=frame, twist__linear__x=speed,
                   twist__angular__z=turn)  # fmt: skip


SAFE_BYTES = command(0.0, "base", 0.5)


def drive(monitors: MonitorSet, data: bytes, time: int = 5) -> bytes:
    outcome = monitors.process("/cmd_vel", bytearray(data), time)
    return b"" if outcome.result == "dropped" else bytes(outcome.buffer)


def sent(outcomes: list[Outcome]) -> list[Any]:
    return [fields(one.type, one.data) for outcome in outcomes for one in outcome.sent_messages()]


def test_a_stop_replaces_the_message_and_keeps_its_stamp() -> None:
    monitors = load(guard())
    assert drive(monitors, command()) == command()
    monitors.process("/scan", NEAR, 1)
    outcome = monitors.process("/cmd_vel", bytearray(command()), 2)
    assert (outcome.result, bytes(outcome.buffer)) == ("changed", SAFE_BYTES)
    assert (outcome.changed_by, [position.line for position in outcome.changed_at]) == (("guard.drive",), [1])
    assert monitors.process("/cmd_vel", SAFE_BYTES, 3).result == "passed"


def test_a_safe_message_is_known_by_its_topic_and_bytes_while_its_monitor_is_enabled() -> None:
    monitors = load(guard())
    messages = [("/cmd_vel", SAFE_BYTES), ("/cmd_vel", command()), ("/scan", SAFE_BYTES)]
    assert [monitors.is_safe(*one) for one in messages] == [True, False, False]
    monitors.switch({"guard": False}, 1)
    assert not monitors.is_safe("/cmd_vel", SAFE_BYTES)


def test_a_stop_without_a_message_of_its_topic_is_published() -> None:
    text = guard(SAFE, SCAN.replace("near = r[0];", "STOP;"), DRIVE, "event e() every 1s { STOP; }")
    monitors = load(text)
    [scan] = sent([monitors.process("/scan", NEAR, 2 * 10**9 + 5)])
    assert (scan.header.stamp.sec, scan.header.stamp.nanosec, scan.header.frame_id) == (2, 5, "base")
    assert len(sent(monitors.advance(3 * 10**9))) == 1


def test_monitors_behind_a_stop_see_the_safe_message() -> None:
    behind = f"""behind() {{ event fast(double v) /cmd_vel {TWIST} '{{twist.linear.x:v}}' when (v > 0) {{ }}
        event slow(double z) /cmd_vel {TWIST} '{{twist.angular.z:z}}' {{ z = 0.25; }}
        ere: fast @match {{ ROS_WARN("fast"); }} }}"""
    monitors = load(guard(), y=behind)
    monitors.process("/scan", NEAR, 1)
    outcome = monitors.process("/cmd_vel", bytearray(command()), 2)
    assert bytes(outcome.buffer) == command(0.0, "base", 0.25)
    assert (outcome.events, outcome.verdicts) == (("guard.drive", "behind.slow"), ())


FAULTY = [
    (guard(SAFE, SCAN, DRIVE.replace("if (near < 1)", "double w = near; int n = 0; n = 1 / n; if (w < 1)")),
     command()),
    (guard(SAFE, SCAN, DRIVE.replace("if (near < 1)", "while (true) { } if (near < 1)")), command()),
    (guard(), command()[:25]),
    (guard(), b""),
]  # fmt: skip


@pytest.mark.parametrize(("text", "data"), FAULTY)
def test_a_fault_on_a_command_sends_the_safe_message(text: str, data: bytes) -> None:
    monitors = load(text)
    found = fields(TWIST, drive(monitors, data))
    assert (found.header.frame_id, found.twist.linear.x, found.twist.angular.z) == ("base", 0, 0.5)
    assert drive(load(text, on_fault="pass"), data) == data


def test_time_that_one_monitor_used_up_is_given_again() -> None:
    monitors = load(FAULTY[1][0], y=guard(head="other()"))
    monitors.limit_time(itertools.count(step=0.001).__next__, 0.05)
    outcome = monitors.process("/cmd_vel", bytearray(command()), 1)
    assert ["processor time" in fault.text for fault in outcome.faults] == [True]
    assert bytes(outcome.buffer) == SAFE_BYTES


def held(how: str) -> MonitorSet:
    monitors = load(
        guard(*(["init() { near = 1 / int(near - 9); }", SAFE, SCAN, DRIVE] if how == "broken" else ()))
    )
    if how == "fault":
        monitors.process("/scan", EMPTY, 1)
    elif how == "lost":
        monitors = MonitorSet.of(compiled_from({"x.rv": guard()}, definitions()))
        monitors.recover([], {"": "power cut"}, 0)
    elif how == "changed":
        monitors.process("/scan", NEAR, 1)
        after = MonitorSet.of(compiled_from({"x.rv": guard().replace("< 1", "< 2")}, definitions()))
        after.succeed(monitors, 1)
        monitors = after
    return monitors


@pytest.mark.parametrize("how", ["fault", "lost", "changed", "broken"])
def test_a_monitor_that_cannot_judge_passes_and_sends_only_the_safe_message(how: str) -> None:
    monitors = held(how)
    times = [TENTH, TENTH + 1, 2 * TENTH, 9 * TENTH, 9 * TENTH + 1]
    outcomes = [monitors.advance(time) for time in times]
    series = [[one.header.stamp.nanosec for one in sent(found)] for found in outcomes]
    assert series == [[TENTH], [], [2 * TENTH], [9 * TENTH], []]
    assert [one.repeated for found in outcomes for one in found] == [False, True, True]
    given = [command(), SAFE_BYTES, SAFE_BYTES[4:]]
    assert [drive(monitors, data, 9 * TENTH + 2) for data in given] == [b"", SAFE_BYTES, b""]
    if how != "broken":
        monitors.resume("guard")
        assert (monitors.next_due, drive(monitors, command(), 10 * TENTH)) == (None, command())


def test_a_monitor_that_starts_again_sends_until_the_first_command() -> None:
    restarted, first = (MonitorSet.of(compiled_from({"x.rv": guard()}, definitions())) for _ in range(2))
    first.start(0)
    assert first.next_due is None
    restarted.start(0, restarted=True)
    begun = load(guard(head="begin guard()"))
    begun.process("/scan", EMPTY, 1)
    for monitors in (restarted, begun):
        assert len(sent(monitors.advance(TENTH))) == 1
        monitors.process("/scan", message("sensor_msgs/LaserScan", ranges=[5.0]), TENTH)
        assert drive(monitors, command()) == command()
        assert monitors.next_due is None


@pytest.mark.parametrize("on_fault", ["drop", "pass"])
def test_a_monitor_that_is_disabled_or_in_shadow_mode_sends_nothing(on_fault: OnFault) -> None:
    compiled_set = compiled_from({"x.rv": guard()}, definitions())
    shadowed = MonitorSet.of(compiled_set, on_fault, shadows=["guard"])
    shadowed.start(0, restarted=True)
    assert not sent(shadowed.advance(TENTH))
    disabled = held("lost")
    disabled.switch({"guard": False}, 1)
    assert (disabled.next_due, drive(disabled, command())) == (None, command())


def test_a_safe_message_passes_only_monitors_behind_that_do_not_forbid_it() -> None:
    monitors = load(
        guard(), y=f"cap() {{ event c(double z) /cmd_vel {TWIST} '{{twist.angular.z:z}}' {{ z = 0; }} }}"
    )
    monitors.hold(monitors.monitor("guard"), "test")
    assert [one.twist.angular.z for one in sent(monitors.advance(1))] == [0]


REFUSED = [
    (SAFE.replace("/cmd_vel", "/other"), "no event of guard is on /other"),
    (SAFE + SAFE, "declared twice"),
    (SAFE.replace(TWIST, "geometry_msgs/Twist").replace("header:{frame_id:\"base\"}, ", "").replace("twist.", ""),
     f"/cmd_vel has the type {TWIST} in an event"),
    (SAFE.replace("0.5", "near"), "constants"),
    (SAFE.replace("frame_id", "frame"), "has no field `frame`"),
    (SAFE.replace('frame_id:"base"', "seq:5"), "are set when the message is sent"),
    (SAFE.replace('"base"', "5"), "cannot hold 5"),
    (SAFE.replace("100ms", "0ms"), "a period is from 1 ms"),
    ("", "`STOP;` sends the safe message, and there is none"),
    (SAFE + "void f() { STOP; }", "a function has no message"),
    (SAFE.replace("on /cmd_vel", "/cmd_vel"), "expected `on`"),
]  # fmt: skip


@pytest.mark.parametrize(("safe", "why"), REFUSED)
def test_a_safe_message_that_cannot_be_sent_is_refused(safe: str, why: str) -> None:
    assert any(why in one.text for one in refused(guard(safe, SCAN, DRIVE)))


def test_old_files_may_use_the_new_words_as_names() -> None:
    monitors = load("s() { const int STOP = 2; bool safe = true; int on; event e(int x) /t std_msgs/Int32 '{data:x}'"
                    " { on = STOP; switch (x) { case STOP: safe = x != STOP; } } }")  # fmt: skip
    monitors.process("/t", message("std_msgs/Int32", data=2), 1)
    assert (monitors.value("s", "on"), monitors.value("s", "safe")) == (2, False)


# Formulas


def stopping(formula: str) -> str:
    parts = [f"event {name}() /{name} std_msgs/Int32 '{{}}' {{ }} safe std_msgs/Int32 {{data:-1}} on /{name} every 1s;"
             for name in ABC]  # fmt: skip
    return f"s() {{ {' '.join(parts)} {formula} @violation {{ STOP; }} }}"


def passed(monitors: MonitorSet, trace: Timed) -> list[bool]:
    found = []
    for event, time in ((event, time) for time, event in trace):
        outcome = monitors.process(f"/{event}", bytearray(message("std_msgs/Int32", data=1)), time)
        value = fields("std_msgs/Int32", bytes(outcome.buffer)).data
        assert (outcome.result, value) in {("passed", 1), ("changed", -1)}
        found.append(value == 1)
    return found


@pytest.mark.parametrize("formula", FORMULAS)
def test_a_stopped_message_has_not_happened_for_formulas(formula: str) -> None:
    logic, _, text = formula.partition(": ")
    property_, random = compiled(logic, text), seeded(31)
    traces = [timed(random, 9) for _ in range(examples(60))]
    traces += [
        [(2 * place + 1, event) for place, event in enumerate(events)] for events in product(ABC, repeat=3)
    ]
    for trace in traces:
        assert passed(load(stopping(formula)), trace) == projected(property_, trace), trace


ON_PLAIN = "safe own/Plain {count:5} on /plain every 1s;"
STOPPING = [
    f"""s() {{ int n; {ON_PLAIN}
        event e(int c) /plain own/Plain '{{count:c}}' {{
            n += c; if (c > 6) {{ STOP; n++; c = 9; if (n % 7 == 0) {{ return; }} }} else {{ c = c + n % 2; }} }}
        event f(int c) /plain own/Plain '{{count:c}}' when (c == 5) {{ n += 100; if (n % 3 == 0) {{ STOP; }} }}
        pattern: globally: e forbids f @violation {{ n++; }} ltl: [](e => o f) @violation {{ n += 3; }} }}""",
    f"""s() {{ int n; std::string last; {ON_PLAIN}
        event e(int c) /plain own/Plain '{{count:c}}' {{
            n += c; last = "a"; if (c > 6) {{ STOP; last = "b"; }} c = 5; }}
        tfsm: a [ e -> b ] b [ e -> a, timeout 2ms -> a ] @timeout {{ n += 1000; }}
        fsm: a [ e -> b ] b [ e -> a ] @b {{ n++; }} }}""",
    f"""s() {{ int n; {ON_PLAIN} event e(int c) /plain own/Plain '{{count:c}}' {{ n += c; if (c > 6) {{ STOP; }} }}
        ere: (e e e)* @fail {{ STOP; __RESET; }} @match {{ if (n % 3 == 0) {{ STOP; }} }} }}""",
    f"""s() {{ int n; {ON_PLAIN} event e(int c) /plain own/Plain '{{count:c}}' when (c != 4) {{ }}
        event f(int c) /plain own/Plain '{{count:c}}' when (c == 4) {{ }}
        event g(int c) /plain own/Plain '{{count:c}}' when (c > 6) {{ STOP; }}
        ptltl: f -> (*) f @violation {{ n++; }} }}""",
]  # fmt: skip


@pytest.mark.parametrize("text", STOPPING)
def test_the_module_and_the_interpreter_stop_the_same_messages(text: str) -> None:
    others = [
        text.replace("s()", f"{name}()").replace("> 6", limit) for name, limit in (("t", "> 4"), ("u", "< 2"))
    ]
    both = BothWays(text, *others)
    random, time = seeded(32), 1
    for _ in range(examples(60)):
        time += random.choice((0, 1, 10**6, 10**9))
        sizes = [random.choice((0, 0, 0, 3)) for _ in range(8)]
        both.check([plain(random.randint(0, 9), rest=bytes(size)) for size in sizes], time=time)
    assert both.came["together"] and both.came["changed"]


ALTERING = {
    "a stop": "if (c > 6) { STOP; }",
    "a change": "if (c > 6) { c = 1; }",
    "a change of some": "if (c > 6) { c = c & 8; }",
}
ASKING = """(int n = 0; event e(int c) /plain own/Plain '{count:c}' {
    if (altered(e)) { n++; ROS_INFO("%d", c); if (c == 8) { c = 3; } } else if (c == 2) { return; } } }"""


@pytest.mark.parametrize("how", ALTERING)
def test_the_module_and_the_interpreter_know_alike_which_messages_are_altered(how: str) -> None:
    """A message that the first specification leaves as it was is not altered, even if it is the safe one."""
    first = f"a() {{ {ON_PLAIN} event e(int c) /plain own/Plain '{{count:c}}' {{ {ALTERING[how]} }} }}"
    both = BothWays(first, *(f"{name}() {{ {ASKING[1:]}" for name in "bc"))
    random, told = seeded(34), 0
    for time in range(1, 40):
        counts = [random.randint(0, 9) for _ in range(8)]
        both.check([plain(count) for count in counts], time=time)
        told += len(both.lines)
        changed = {"a stop": {7, 8, 9}, "a change": {7, 8, 9}, "a change of some": {7, 9}}[how]
        assert sum(line.monitor == "b" for line in both.lines) == sum(count in changed for count in counts)
    assert told


def test_a_message_is_altered_for_later_events_if_a_monitor_published_it_and_in_shadow_mode() -> None:
    asking = (
        "b() { event e(int c) /plain own/Plain '{count:c}' { if (altered(e)) { ROS_INFO(\"%d\", c); } } }"
    )
    tick = f"a() {{ {ON_PLAIN} event e() /plain own/Plain '{{}}' {{ }} event t() every 1s {{ STOP; }} }}"
    monitors = MonitorSet.of(compiled_from({"a.rv": tick, "b.rv": asking}, random_definitions()))
    monitors.start(0)
    assert not monitors.process("/plain", plain(4), 1).log
    [published] = monitors.advance(2 * 10**9)
    [judged] = published.judged.values()
    assert [line.text for line in judged.log] == ["5"]
    change = "a() { event e(int c) /plain own/Plain '{count:c}' { if (c > 6) { c = 1; } } }"
    sources = {"a.rv": change, "b.rv": asking}
    shadowed = MonitorSet.of(compiled_from(sources, random_definitions()), shadows=("b",))
    shadowed.start(0)
    for count, lines in ((4, []), (7, ["1"])):
        shadowed.process("/plain", bytearray(plain(count)), 1)
        outcome = shadowed.tapped.pop().give()
        assert [line.text for line in outcome.log] == lines


STAMPED = f"""s() {{ int n; {SAFE} event e(double v) /cmd_vel {TWIST} '{{twist.linear.x:v}}' {{
    if (v > 6) {{ STOP; }} v = n++ % 3; }} }}"""


def test_the_module_sends_the_safe_message() -> None:
    both, random = BothWays(STAMPED), seeded(33)
    alike = [command(float(random.randint(0, 9)), "bose", random.choice((0.5, 1.0))) for _ in range(100)]
    both.check(alike, "/cmd_vel")
    assert both.came["together"] == 1
    both.check([*alike, command(9, "joystick")], "/cmd_vel")
    assert both.came["together"] == 2
    lane = BothWays(f"s() {{ {SAFE} event e() /cmd_vel {TWIST} '{{}}' {{ STOP; }} }}").lane("/cmd_vel")
    for data, result in ((command(9, "bose"), "changed"), (SAFE_BYTES, "passed")):
        outcome = lane.process_message(data, 1, lane.prepare(loud=False, told=()))
        assert outcome is not None
        assert (outcome.result, bytes(outcome.buffer)) == (result, SAFE_BYTES)


def test_a_string_of_the_message_is_kept_before_it_is_replaced() -> None:
    both = BothWays(f"""s() {{ std::vector<uint8_t> kept; {ON_PLAIN}
        event e(int c, std::vector<uint8_t> r) /plain own/Plain '{{count:c, rest:r}}' {{
            kept = r; if (c > 6) {{ STOP; }} }} }}""")  # fmt: skip
    both.check([plain(number, rest=b"abc") for number in range(10)])
    assert both.came["together"] == 1
