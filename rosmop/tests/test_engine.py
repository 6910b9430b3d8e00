"""The running monitors: order, shared variables, properties and handlers, time, faults, swaps, services."""

# ruff: noqa: E501  the rows of tables

from collections.abc import Callable

import pytest

from rosmop.check.sources import compiled_from
from rosmop.run.engine import MonitorSet
from rosmop.run.outcomes import Outcome
from rosmop.run.timers import MAX_TICKS
from rosmop.runtime.wire import Message
from rosmop.tests.acting import definitions, load, message, refused
from rosmop.tests.examples import examples
from rosmop.tests.random_specifications import Messages, Specifications
from rosmop.tests.random_specifications import definitions as random_definitions
from rosmop.tests.reload import replaced
from rosmop.text.errors import SpecificationError
from roswire.definitions import Definitions

SECOND = 10**9


def number(value: int) -> bytes:
    """A `std_msgs/Int32`."""
    return message("std_msgs/Int32", data=value)


def on(topic: str, name: str = "e", body: str = "", parameters: str = "") -> str:
    """An event on a topic of `std_msgs/Int32`, its value bound to `x`."""
    return f"event {name}(int x{parameters}) {topic} std_msgs/Int32 '{{data:x}}' {{ {body} }}\n"


def printed(outcome: Outcome) -> list[str]:
    """What was printed."""
    assert not outcome.faults, outcome.faults
    return [line.text for line in outcome.log]


# Order and sharing


def test_events_happen_in_the_order_of_files_and_text() -> None:
    """Specifications in the order given, events in source order, for each message."""
    one = (
        "b() {"
        + on("/t", "p", 'ROS_INFO("1");')
        + on("/t", "o", 'ROS_INFO("2");')
        + "}"
        + "a() {"
        + on("/t", "e", 'ROS_INFO("3");')
        + "}"
    )
    outcome = load(one, z="c() {" + on("/t", "e", 'ROS_INFO("4");') + "}").process("/t", number(1), 0)
    assert printed(outcome) == ["1", "2", "3", "4"]
    assert list(outcome.events) == ["b.p", "b.o", "a.e", "c.e"]


def test_a_dropped_message_is_not_seen_by_later_events() -> None:
    """`return;` ends the way of the message, also before the property of its own specification."""
    text = (
        "a() {"
        + on("/t", "e", "return;")
        + on("/t", "f")
        + 'ere: e @match { ROS_INFO("m"); } } b() {'
        + on("/t")
        + "}"
    )
    outcome = load(text).process("/t", number(1), 0)
    assert (outcome.result, list(outcome.events), outcome.verdicts) == ("dropped", ["a.e"], ())


def test_a_topic_without_events_is_passed_on_as_it_is() -> None:
    """The buffer that comes out is the one that went in."""
    monitors = load("a() {" + on("/t") + "}")
    buffer = bytearray(b"anything")
    outcome = monitors.process("/other", buffer, 0)
    assert (outcome.result, outcome.buffer is buffer, monitors.wants("/other")) == ("passed", True, False)


def test_monitors_share_variables() -> None:
    """A specification sees its own variables first, then those of the others, and may assign them."""
    text = "a() { int n = 5; int own = 1;" + on("/t", "e", "n = x; own = 7;") + "}"
    other = "b() { int own = 2;" + on("/u", "e", 'ROS_INFO("%d %d", n, own); n = 100;') + "}"
    monitors = load(text, y=other)
    assert printed(monitors.process("/u", number(0), 0)) == ["5 2"]
    monitors.process("/t", number(42), 1)
    assert printed(monitors.process("/u", number(0), 2)) == ["42 2"]


@pytest.mark.parametrize(
    ("parameter", "when", "body"),
    [
        ("shared", "when (shared < 3)", ""),
        ("shared", "", "shared = 1 / (shared - 3);"),
        ("x", "", "int shared = 3, other = 1 / (shared - x); x = other;"),
        ("x", "", "for (int shared = 3; shared < 5; shared += 2) { x++; }"),
        ("x", "", "std::vector<int> all = {x}; for (int shared : all) { x = 1 / shared; }"),
    ],
)
def test_a_name_of_its_own_is_no_use_of_the_others_variable(parameter: str, when: str, body: str) -> None:
    """So the two are switched, tried, moved and removed apart; only where it means the other's is it a use."""
    event = f"event e(int {parameter}) /t std_msgs/Int32 '{{data:{parameter}}}' {when} {{ {body} }}"
    other = "other() { int shared = 0; event e() /u std_msgs/Empty '{}' { shared++; } }"
    for text, uses in (("", set()), ("event f() /u std_msgs/Empty '{}' when (shared > 1) { }", {"other"})):
        monitors = load(f"own() {{ {event} {text} }}", other=other)
        assert monitors.monitor("own").code.uses == uses


def test_a_name_that_two_others_declare_is_an_error() -> None:
    """Which one would be meant is not guessed; the same name in two specifications is a warning."""
    both = "a() { int n;" + on("/t") + "} b() { int n;" + on("/t") + "}"
    [finding] = refused(both + "c() {" + on("/t", "e", "n = 1;") + "}")
    assert finding.text == "`n` is a variable of a and b; give one of them another name"
    [warning] = load(both).warnings
    assert (warning.severity, warning.text) == ("warning", "`n` is also a variable of a; each has its own")


def test_functions_belong_to_their_specification() -> None:
    """A helper function of another specification is not called, and the refusal says whose it is."""
    text = "a() { int f() { return 1; }" + on("/t") + "} b() {" + on("/t", "e", "x = f();") + "}"
    assert "`f` is a function of a; functions belong to their specification" in refused(text)[0].text


def test_init_runs_once_before_the_first_message() -> None:
    """First values, then `init`; what it prints comes with the start."""
    text = (
        'a() { int n = 3; init() { n = n * 2; ROS_INFO("init %d", n); }'
        + on("/t", "e", 'ROS_INFO("%d", n++);')
        + "}"
    )
    monitors = MonitorSet.of(compiled_from({"x.rv": text}, definitions()))
    assert printed(monitors.start(0)) == ["init 6"]
    assert [printed(monitors.process("/t", number(0), i)) for i in (1, 2)] == [["6"], ["7"]]


def test_a_monitor_whose_init_faults_lets_nothing_pass() -> None:
    """Without a state to judge by, messages are dropped, with the reason."""
    text = "a() { int n; init() { n = 1 / n; }" + on("/t") + "}"
    monitors = MonitorSet.of(compiled_from({"x.rv": text}, definitions()))
    assert [fault.text for fault in monitors.start(0).faults] == ["division by zero"]
    outcome = monitors.process("/t", number(0), 1)
    assert (outcome.result, outcome.reason) == (
        "dropped",
        "a could not begin: its first values or `init` faulted",
    )


# Who did it


@pytest.mark.parametrize(
    ("bodies", "given", "result", "changed_by"),
    [
        (("x = 0;", ""), 5, "changed", ["a.e"]),
        (("", "x = 0;"), 5, "changed", ["b.e"]),
        (("x = 5;", "x = 6;"), 5, "changed", ["b.e"]),
        (("x = x + 1;", "x = x + 1;"), 5, "changed", ["a.e", "b.e"]),
        (("x = x + 1;", "x = x - 1;"), 5, "passed", []),
        (("x = 0;", "return;"), 5, "dropped", []),
        (("x = 5;", ""), 5, "passed", []),
        (("x = 7; DROP;", ""), 5, "dropped", []),
        (("x = 7; x = 1 / (x - 7);", "x = 3;"), 5, "changed", ["b.e"]),
    ],
)
def test_a_change_is_by_the_events_that_made_the_bytes_others(
    bodies: tuple[str, str], given: int, result: str, changed_by: list[str]
) -> None:
    """Not by one that happened later, assigned what was there, or faulted before it was written."""
    texts = {
        f"{name}.rv": f"{name}() {{" + on("/t", "e", body) + "}"
        for name, body in zip("ab", bodies, strict=True)
    }
    monitors = MonitorSet.of(compiled_from(texts, definitions()), "pass")
    monitors.start(0)
    outcome = monitors.process("/t", bytearray(number(given)), 0)
    assert (outcome.result, list(outcome.changed_by)) == (result, changed_by)


ASSIGNS = """a() {
    void twice(double& v) {
        v = v * 2; }
    event e(double x, double y, std::vector<double> c, std::string f) /p geometry_msgs/PoseWithCovarianceStamped
        '{header:{frame_id:f}, pose:{pose:{position:{x:x, y:y}}, covariance:c}}' {
        if (x < 0) {
            x = 0; }
        if (x > 1) {
            x = 1;
            y = y + (x = 0.5); }
        c[0] = 7;
        c[1] = x;
        f = f + f;
        twice(y); }
}
b() { event e(double x) /p geometry_msgs/PoseWithCovarianceStamped '{pose:{pose:{position:{x:x}}}}' {
    x = x + 0; } }"""


@pytest.mark.parametrize(
    ("x", "y", "frame", "lines"),
    [
        (-1.0, 0.0, "", [7, 11, 12]),
        (5.0, 1.0, "map", [9, 10, 11, 12, 13, 14]),
        (0.5, 3.0, "", [11, 12, 14]),
        (0.0, 0.0, "", [11, 12]),
    ],
)
def test_a_change_stands_where_the_changed_fields_were_assigned(
    x: float, y: float, frame: str, lines: list[int]
) -> None:
    """Every statement that assigned to a field whose bytes are others, also as part of another, or by a function."""
    monitors = MonitorSet.of(compiled_from({"x.rv": ASSIGNS}, definitions()))
    monitors.start(0)
    kind = "geometry_msgs/PoseWithCovarianceStamped"
    body = message(kind, header__frame_id=frame, pose__pose__position__x=x, pose__pose__position__y=y)
    outcome = monitors.process("/p", bytearray(body), 0)
    assert [one.line for one in outcome.changed_at] == lines


DROPS = {
    "the event itself": ("a() {" + on("/t", "e", "x = 9;") + "} b() {" + on("/t", "e", "return;") + "}", "b", None),
    "a handler": ("a() {" + on("/t") + "} b() {" + on("/t") + "ere: e @match { DROP; } } c() {" + on("/t") + "}", "b", None),
    "a handler, the next one goes on": ("a() {" + on("/t") + "ere: e @match { DROP; } ptltl: e @validation { } } b() {" + on("/t") + "}", "a", None),
    "a fault": ("a() {" + on("/t") + "} b() {" + on("/t", "e", "x = 1 / (x - 5);") + "}", "b", "b"),
    "a fault in a condition": ("a() {" + on("/t") + "} b() { event e(int x) /t std_msgs/Int32 '{data:x}' when (1 / (x - 5) > 0) { } }", "b", "b"),
    "a fault in a handler": ("a() {" + on("/t") + "} b() { int n;" + on("/t") + "ere: e @match { n = 1 / n; } }", "b", "b"),
    "first values": ("a() {" + on("/t") + "} b() { int n; init() { n = 1 / n; }" + on("/t") + "}", "b", None),
}  # fmt: skip


@pytest.mark.parametrize("name", DROPS)
def test_a_drop_is_by_the_monitor_that_dropped(name: str) -> None:
    """By its event, a handler of its property, or its fault, whichever events happened before."""
    text, by, faulty = DROPS[name]
    outcome = load(text).process("/t", bytearray(number(5)), 0)
    fatal = outcome.fatal.monitor if outcome.fatal is not None else None
    assert (outcome.result, outcome.dropped_by, fatal) == ("dropped", by, faulty)
    assert not outcome.events or outcome.events[-1] in ("a.e", "b.e")


def test_a_fault_that_is_passed_over_has_dropped_nothing() -> None:
    """With `on_fault: pass` the drop is of who dropped, not of who faulted before it."""
    text = "a() {" + on("/t", "e", "x = 1 / (x - 5);") + "} b() {" + on("/t", "e", "return;") + "}"
    monitors = MonitorSet.of(compiled_from({"x.rv": text}, definitions()), "pass")
    monitors.start(0)
    outcome = monitors.process("/t", bytearray(number(5)), 0)
    assert [fault.monitor for fault in outcome.faults] == ["a"]
    assert (outcome.result, outcome.dropped_by, outcome.fatal) == ("dropped", "b", None)


def test_a_held_monitor_drops_what_others_let_pass() -> None:
    """It is named although the events of another happened."""
    monitors = load("a() {" + on("/t") + "} hold b() {" + on("/t") + "}")
    monitors.start(0, restarted=True)
    outcome = monitors.process("/t", bytearray(number(5)), 0)
    assert (outcome.dropped_by, list(outcome.events)) == ("b", ["a.e"])


def test_what_is_published_is_of_who_published_it() -> None:
    """Not of the monitor whose event comes after."""
    text = (
        "a() { std_msgs::Int32 n;"
        + on("/t", "e", "PUBLISH(/n, std_msgs/Int32, n);")
        + "} b() {"
        + on("/t")
        + "}"
    )
    assert [one.monitor for one in load(text).process("/t", number(1), 0).published] == ["a"]


def test_changes_are_by_whom_a_comparison_of_all_bytes_finds() -> None:
    """Random monitors: the bytes before and after each event say who changed what, and whether anything is changed."""
    most = 0
    for seed in range(examples(60)):
        try:
            monitors = MonitorSet.of(
                compiled_from(
                    {f"{place}.rv": text for place, text in enumerate(Specifications(seed).texts())},
                    random_definitions(),
                ),
                ("drop", "pass")[seed % 2],
            )
        except SpecificationError:
            continue
        found: list[str] = []
        for step in (step for monitor in monitors.monitors for step in monitor.steps):
            step.function = _compared(step.name, step.function, found)
        monitors.start(0)
        messages = Messages(seed)
        for traffic in (messages.traffic() for _ in range(20)):
            for body in traffic.bodies():
                found.clear()
                outcome = monitors.process(traffic.topic, bytearray(body), 5)
                changed = outcome.result != "dropped" and bytes(outcome.buffer) != body
                assert (outcome.result == "changed") == changed
                assert list(outcome.changed_by) == (found if changed else [])
                most = max(most, len(outcome.changed_by))
    assert most > 1


def _compared(
    name: str, function: Callable[[Message | None], bool], found: list[str]
) -> Callable[[Message | None], bool]:
    """The function of an event; its name is added to `found` when all bytes are not what they were."""

    def compared(seen: Message | None) -> bool:
        assert seen is not None
        before = bytes(seen.buffer)
        try:
            return function(seen)
        finally:
            if bytes(seen.buffer) != before:
                found.append(name)

    return compared


# Properties


FSM = """a() { int n;
    event go(int x) /t std_msgs/Int32 '{data:x}' when (x > 0) { n = x; }
    event stop(int x) /t std_msgs/Int32 '{data:x}' when (x <= 0) { }
    fsm: idle [ go -> moving, stop -> idle ] moving [ go -> moving, stop -> idle ]
    @moving { ROS_INFO("moving %d", n); }
}"""


def test_a_handler_runs_on_every_event_while_in_its_category() -> None:
    """The property steps after the action; the handler of the state it is in runs each time."""
    monitors = load(FSM)
    seen = [printed(monitors.process("/t", number(value), i)) for i, value in enumerate((0, 4, 5, 0, 6))]
    assert seen == [[], ["moving 4"], ["moving 5"], [], ["moving 6"]]
    verdict = monitors.process("/t", number(7), 9).verdicts[0]
    assert (verdict.monitor, verdict.property, verdict.logic, verdict.category) == ("a", 0, "fsm", "moving")


def test_a_verdict_can_block_the_message_that_caused_it() -> None:
    """`DROP;` in a handler drops the message; the other properties step all the same."""
    text = "a() {" + on("/t") + 'ere: e @match { DROP; } ere: e e @match { ROS_INFO("second"); } }'
    monitors = load(text)
    first, second = (monitors.process("/t", number(1), i) for i in (0, 1))
    assert (first.result, second.result, printed(second)) == ("dropped", "passed", ["second"])


def test_fail_is_sticky_until_reset() -> None:
    """`fail` goes on; `__RESET;` starts the property anew when all handlers of the event have run."""
    sticky = load("a() {" + on("/t") + on("/u", "f") + 'ere: e f @fail { ROS_INFO("fail"); } }')
    assert [printed(sticky.process("/t", number(1), i)) for i in range(3)] == [[], ["fail"], ["fail"]]
    reset = load("a() {" + on("/t") + on("/u", "f") + 'ere: e f @fail { __RESET; ROS_INFO("fail"); } }')
    assert [printed(reset.process("/t", number(1), i)) for i in range(4)] == [[], ["fail"], [], ["fail"]]


def test_reset_is_for_its_own_property() -> None:
    """The run of another property of the specification goes on."""
    text = "a() {" + on("/t") + 'ere: e @match { __RESET; } ere: e e e @match { ROS_INFO("three"); } }'
    monitors = load(text)
    assert [printed(monitors.process("/t", number(1), i)) for i in range(3)] == [[], [], ["three"]]


def test_handlers_run_in_source_order() -> None:
    """When a property is in several categories, their handlers run as they stand."""
    text = (
        "a() {"
        + on("/t")
        + 'fsm: s [ e -> t ] t [ e -> t ] alias both = t @both { ROS_INFO("alias"); } @t { ROS_INFO("state"); } }'
    )
    assert printed(load(text).process("/t", number(1), 0)) == ["alias", "state"]


BAD_PROPERTIES = [
    ("ere: e @match { DROP; } @match { }", "@match is handled twice"),
    ("ere: e @violation { }", "ere has no category `violation` here; there are: match, fail"),
    ("ere: q @match { }", "`q` is not an event of this specification"),
    ("foo: e @match { }", "there is no logic `foo`"),
    (
        "ere: e @match { geometry_msgs::Point p = MESSAGE; }",
        "a handler has no message; copy it in the action",
    ),
    ("ere: e @match { x = 1; }", "there is no variable `x`"),
    ("tfsm: s [ e -> s, timeout 1s -> s ] @timeout { DROP; }", "`DROP;` cannot stand here"),
    ("pattern: globally: e causes f within 1s @violation { DROP; }", "`DROP;` cannot stand here"),
]


@pytest.mark.parametrize(("text", "reason"), BAD_PROPERTIES)
def test_a_property_that_cannot_be(text: str, reason: str) -> None:
    """Properties and handlers that cannot do what they say are refused with the reason."""
    assert reason in refused("a() {" + on("/t") + on("/u", "f") + text + "}")[0].text


def test_a_handler_that_a_timer_can_run_may_not_drop() -> None:
    """A timer has no message, so the handler of its category cannot block one."""
    text = "a() {" + on("/t") + "event tick() every 1s { } ere: e | tick @match { DROP; } }"
    assert "the timer `tick` can bring @match about" in refused(text)[0].text


def test_lint() -> None:
    """Events that no property uses and handlers that never run are warnings with their places."""
    text = "a() {" + on("/t") + on("/u", "f") + "\nere: e e @match { } }"
    assert [finding.text for finding in load(text).warnings] == ["no property uses the event `f`"]
    never = "a() {" + on("/t") + "\nltl: [] (e or not e) @violation { } }"
    warnings = [(finding.position.line, finding.text) for finding in load(never).warnings]
    assert any("never runs" in text and line == 3 for line, text in warnings)


# Time


def test_ticks_come_one_period_after_the_first_message() -> None:
    """A timer starts with the first message of its specification; ticks are told before the message."""
    monitors = load(
        "a() { int n; event tick() every 100ms { n++; }" + on("/t", "e", 'ROS_INFO("%d", n);') + "}"
    )
    assert monitors.process("/t", number(0), 50_000_000).before == ()
    outcome = monitors.process("/t", number(0), 360_000_000)
    assert [(each.timer, each.time, list(each.events)) for each in outcome.before] == [
        ("a.tick", 150_000_000, ["a.tick"]), ("a.tick", 250_000_000, ["a.tick"]), ("a.tick", 350_000_000, ["a.tick"]),
    ]  # fmt: skip
    assert printed(outcome) == ["3"]


def test_ticks_come_without_messages_too() -> None:
    """When no message comes, ticks count from the start, and the caller is told when the next is due."""
    monitors = load('a() { event tick() every 2s { ROS_INFO("%d", ros::Time::now().sec); }' + on("/t") + "}")
    assert monitors.next_due == 2 * SECOND
    assert monitors.advance(SECOND) == []
    assert [printed(each) for each in monitors.advance(5 * SECOND)] == [["2"], ["4"]]
    assert monitors.next_due == 6 * SECOND


def test_timers_wait_for_messages_that_are_known_to_come() -> None:
    """In a recording with messages for the specification, the first tick waits for the first of them."""
    monitors = MonitorSet.of(
        compiled_from({"x.rv": "a() { event tick() every 1s { }" + on("/t") + "}"}, definitions())
    )
    monitors.start(0, frozenset({"/t"}))
    assert monitors.next_due is None
    monitors.process("/t", number(0), 10 * SECOND)
    assert monitors.next_due == 11 * SECOND


def test_a_leap_of_the_clock_leaves_ticks_out() -> None:
    """However far the clock jumps, the number of ticks is bounded, and what is left out is told."""
    monitors = load("a() { event tick() every 1ms { } }")
    ticks = monitors.advance(10**18)
    assert len(ticks) == MAX_TICKS
    assert "are left out: the time has made a leap" in ticks[-1].log[0].text
    assert monitors.next_due is not None
    assert monitors.next_due > 10**18


def test_ticks_that_take_too_long_are_left_out_and_deadlines_wait() -> None:
    """What is late would be ever later otherwise; the caller says how long is too long."""
    text = """a() { int n; event e() /t std_msgs/Bool '{}' { } event tick() every 1ms { n++; ROS_INFO("%d", n); } }
    b() { event x() /t std_msgs/Bool '{}' { }
        tfsm: s [ x -> s, timeout 1ms -> late ] late [ ] @timeout { ROS_WARN("late"); } }"""
    answers = iter([False, False, True])
    monitors = load(text, patience=lambda: lambda: next(answers))
    monitors.process("/t", number(0), 0)
    outcomes = monitors.advance(SECOND)
    lines = [line.text for outcome in outcomes for line in outcome.log]
    assert lines == ["1", "late", "2", "998 ticks of a.tick are left out: they take too long"]
    assert monitors.next_due == SECOND + SECOND // 1000


def test_a_tick_steps_the_property() -> None:
    """A timer is an event of the alphabet."""
    text = (
        "a() { event tick() every 1s { }" + on("/t") + 'ere: (tick tick e)+ @match { ROS_INFO("match"); } }'
    )
    monitors = load(text)
    monitors.process("/t", number(0), 0)
    monitors = load(text)
    monitors.advance(2 * SECOND)
    assert printed(monitors.process("/t", number(0), 2 * SECOND)) == ["match"]


TIMED = 'tfsm: s0 [ e -> s1 ] s1 [ e -> s0, timeout 2s -> late ] late [ e -> s0 ] @late { ROS_INFO("late"); } @timeout { ROS_INFO("timeout"); }'


def test_a_deadline_passes() -> None:
    """After the deadline without an event the handlers run: `timeout`, then the state entered."""
    monitors = load("a() {" + on("/t") + TIMED + "}")
    monitors.process("/t", number(0), SECOND)
    assert monitors.advance(3 * SECOND) == []
    [outcome] = monitors.advance(3 * SECOND + 1)
    assert (outcome.timer, outcome.time, printed(outcome)) == ("a.timeout", 3 * SECOND, ["timeout", "late"])
    assert [verdict.category for verdict in outcome.verdicts] == ["timeout", "late"]


def test_an_event_exactly_on_the_bound_is_in_time() -> None:
    """Bounds are closed."""
    monitors = load("a() {" + on("/t") + TIMED + "}")
    monitors.process("/t", number(0), SECOND)
    outcome = monitors.process("/t", number(0), 3 * SECOND)
    assert (outcome.before, printed(outcome)) == ((), [])


def test_a_deadline_is_told_before_the_message_that_is_too_late() -> None:
    """The outcome of the message has what was due before it."""
    monitors = load("a() {" + on("/t") + TIMED + "}")
    monitors.process("/t", number(0), SECOND)
    outcome = monitors.process("/t", number(0), 5 * SECOND)
    assert [each.timer for each in outcome.before] == ["a.timeout"]


def test_throttled_output_goes_by_the_time_of_messages() -> None:
    """`_THROTTLE` counts received time, not the wall clock."""
    monitors = load("a() {" + on("/t", "e", 'ROS_WARN_THROTTLE(1.0, "w");') + "}")
    assert [
        len(monitors.process("/t", number(0), int(t * SECOND)).log) for t in (0, 0.5, 0.99, 1, 1.5, 2)
    ] == [1, 0, 0, 1, 0, 1]


def test_a_timer_may_not_bind_or_drop() -> None:
    """A timer has no message: no parameters, no `DROP;`, no `MESSAGE`."""
    assert "takes no parameters" in refused("a() { event t(int x) every 1s { } }")[0].text
    assert "a timer has no message to drop" in refused("a() { event t() every 1s { DROP; } }")[0].text
    assert (
        "a timer has no message"
        in refused("a() { std_msgs::Bool b; event t() every 1s { b = MESSAGE; } }")[0].text
    )


# Faults


FAULTY = (
    "a() { int n = 1;"
    + on("/t", "e", "x = 5; n = 2; n = n / (x - 5); n = 9;")
    + on("/t", "f", 'ROS_INFO("%d %d", x, n);')
    + "}"
)


def test_a_fault_drops_the_message() -> None:
    """By default what faults drops the message and says where and with what values."""
    outcome = load(FAULTY).process("/t", number(1), 0)
    assert (outcome.result, list(outcome.events), outcome.log) == ("dropped", ["a.e"], ())
    [fault] = outcome.faults
    assert (fault.monitor, fault.position.line, fault.text, fault.values) == (
        "a",
        1,
        "division by zero",
        {"n": 2, "x": 5},
    )


def test_a_fault_can_be_passed_over() -> None:
    """With `pass` the action stops, nothing of it is written to the message, and later events see it."""
    outcome = load(FAULTY, "pass").process("/t", number(1), 0)
    assert (outcome.result, bytes(outcome.buffer)) == ("passed", number(1))
    assert [line.text for line in outcome.log] == ["1 2"]
    assert len(outcome.faults) == 1


def test_a_fault_of_a_handler_drops_the_message() -> None:
    """Handlers fail closed, too."""
    text = "a() { int n;" + on("/t") + "ere: e @match { n = 1 / n; } }"
    outcome = load(text).process("/t", number(1), 0)
    assert (outcome.result, [fault.text for fault in outcome.faults]) == ("dropped", ["division by zero"])


def test_a_property_does_not_step_on_an_event_that_faults() -> None:
    """The event did not complete, so the property does not know of it."""
    text = "a() {" + on("/t", "e", "x = 1 / x;") + 'ere: e @match { ROS_INFO("m"); } }'
    monitors = load(text)
    assert monitors.process("/t", number(0), 0).verdicts == ()
    assert [verdict.category for verdict in monitors.process("/t", number(1), 1).verdicts] == ["match"]


def test_faults_are_counted() -> None:
    """So that a monitor can be shown as failing."""
    monitors = load("a() {" + on("/t", "e", "x = 1 / x;") + "}")
    seen = []
    for i in range(12):
        seen.append(monitors.monitor("a").failing)
        monitors.process("/t", number(0), i)
    assert monitors.monitor("a").faults == 12
    assert seen == [False] * 10 + [True] * 2


def test_a_fault_leaves_the_budget_of_the_next_message_whole() -> None:
    """The budget is for each message."""
    monitors = load(
        "a() {" + on("/t", "e", "for (int i = 0; i < 100000; i++) { x = i; } if (x == 3) while (1);") + "}"
    )
    for i in range(20):
        assert not monitors.process("/t", number(0), i).faults


# Switching, holding, swapping


def test_a_disabled_monitor_does_nothing() -> None:
    """Its events do not happen and messages are relayed untouched; enabled again, it goes on with its state."""
    monitors = load("a() { int n;" + on("/t", "e", 'n++; ROS_INFO("%d", n); return;') + "}")
    monitors.process("/t", number(0), 0)
    monitors.switch({"a": False}, 1)
    outcome = monitors.process("/t", number(0), 1)
    assert (outcome.result, outcome.events, monitors.wants("/t")) == ("passed", (), False)
    monitors.switch({"a": True}, 2)
    assert printed(monitors.process("/t", number(0), 2)) == ["2"]


def test_a_monitor_with_hold_blocks_after_a_restart_until_it_is_resumed() -> None:
    """`hold` keeps the topics blocked; a first start does not."""
    text = "hold a() {" + on("/t") + "} b() {" + on("/u") + "}"
    monitors = load(text)
    assert monitors.process("/t", number(0), 0).result == "passed"
    monitors.start(0, restarted=True)
    outcome = monitors.process("/t", number(0), 1)
    assert (outcome.result, outcome.reason) == ("dropped", "a holds its topics until it is resumed")
    assert monitors.process("/u", number(0), 1).result == "passed"
    monitors.resume("a")
    assert monitors.process("/t", number(0), 2).result == "passed"


def test_an_unchanged_specification_keeps_its_state_through_a_swap() -> None:
    """Variables, runs and timers of what is the same go on; what is new begins."""
    kept = (
        "a() { int n; std::vector<int> v;"
        + on("/t", "e", 'n++; v.push_back(n); ROS_INFO("%d %d", n, (int) v.size());')
        + ('ere: e e e @match { ROS_INFO("three"); } }')
    )
    monitors = load(kept, y="b() { int k = 1;" + on("/u", "e", 'ROS_INFO("%d", k++);') + "}")
    for i in range(2):
        monitors.process("/t", number(0), i)
    changed = {
        "x.rv": "\n// moved down\n" + kept,
        "y.rv": "b() { int k = 5;" + on("/u", "e", 'ROS_INFO("%d", k++);') + "}",
    }
    following, _ = replaced(monitors, changed, definitions(), 10)
    assert printed(following.process("/t", number(0), 11)) == ["3 3", "three"]
    assert printed(following.process("/u", number(0), 11)) == ["5"]


def test_what_goes_on_does_not_begin_again() -> None:
    """Its `init` put out what it had to say at its own beginning; others find its variables as they are now."""
    first = (
        "a() { int n = 1; init() { ROS_WARN(\"begins\"); } event e() /t std_msgs/Bool '{}' { n = n + 1; } }"
    )
    second = (
        "b() { int seen = 0; init() { seen = n; ROS_WARN(\"second\"); } event e() /t std_msgs/Bool '{}' {} }"
    )
    monitors = MonitorSet.of(compiled_from({"a.rv": first}, definitions()))
    assert [line.text for line in monitors.start(0).log] == ["begins"]
    monitors.process("/t", b"\x01", 1)
    following, outcome = replaced(
        monitors,
        {"a.rv": first, "b.rv": second.replace("seen = n;", 'ROS_WARN_STREAM("n is " << n);')},
        definitions(),
        2,
    )
    assert [line.text for line in outcome.log] == ["n is 2", "second"]
    assert len(following.monitors) == 2


def test_a_wrong_set_is_refused_whole() -> None:
    """The set in force stays as it was."""
    monitors = load("a() {" + on("/t", "e", "return;") + "}")
    with pytest.raises(SpecificationError):
        replaced(monitors, {"x.rv": "a() {"}, definitions(), 0)
    assert monitors.process("/t", number(0), 1).result == "dropped"


def test_a_specification_whose_variables_others_use_cannot_be_removed_alone() -> None:
    """The set without it is refused, where its variable is used."""
    user = "b() {" + on("/u", "e", "n = 1;") + "}"
    monitors = load("a() { int n;" + on("/t") + "}", y=user)
    assert monitors.monitor("b").code.uses == {"a"}
    with pytest.raises(SpecificationError, match=r"y\.rv:1.*there is no variable `n`"):
        replaced(monitors, {"y.rv": user}, definitions(), 0)


# Publishing and services


def test_a_published_message_is_encoded_as_others_encode_it() -> None:
    """`PUBLISH` takes a name or a string for topic and type, from actions, functions and handlers."""
    text = """a() { std_msgs::String s; alarm() { PUBLISH("/alarm", "std_msgs::String", s); }
        event e(int x) /t std_msgs/Int32 '{data:x}' { s.data = "n=" + std::to_string(x); alarm(); PUBLISH(/again, std_msgs/String, s); }
        ere: e @match { PUBLISH(/match, std_msgs/String, s); } }"""
    outcome = load(text).process("/t", number(4), 0)
    data = message("std_msgs/String", data="n=4")
    assert [(each.topic, each.type, each.data) for each in outcome.published] == [
        ("/alarm", "std_msgs/String", data), ("/again", "std_msgs/String", data), ("/match", "std_msgs/String", data),
    ]  # fmt: skip
    assert dict(load(text).publications) == {
        "/alarm": "std_msgs/String",
        "/again": "std_msgs/String",
        "/match": "std_msgs/String",
    }


def test_a_topic_has_one_type() -> None:
    """Two types for one topic, in events or in what is published, are an error that names both."""
    two = "a() {" + on("/t") + "event f() /t std_msgs/Bool '{}' { } }"
    assert "/t has the type std_msgs/Int32 at x.rv:1:6, and std_msgs/Bool here" in refused(two)[0].text
    published = "a() { std_msgs::Bool b;" + on("/t", "e", "PUBLISH(/t, std_msgs/Bool, b);") + "}"
    assert "/t has the type std_msgs/Int32" in refused(published)[0].text


SERVICE = """a() {
    event ask(bool on) service /set std_srvs/SetBool request '{data:on}' { if (on) { on = false; } else return; }
    event answer(std::string m) service /set std_srvs/SetBool response '{message:m}' { m = "seen"; }
    ere: ask answer @match { ROS_INFO("served"); }
}"""


def test_requests_and_responses_are_events() -> None:
    """They are matched, changed and refused like messages."""
    monitors = load(SERVICE)
    refusal = monitors.process_service("/set", "request", b"\0", 0)
    request = monitors.process_service("/set", "request", b"\1", 1)
    response = monitors.process_service("/set", "response", b"\1\2\0\0\0ok", 2)
    assert (refusal.result, request.result, bytes(request.buffer)) == ("dropped", "changed", b"\0")
    assert (bytes(response.buffer), printed(response)) == (b"\1\4\0\0\0seen", ["served"])
    assert dict(monitors.services) == {"/set": "std_srvs/SetBool"}
    assert dict(monitors.topics) == {}
    assert monitors.process("/set", b"\0", 3).events == ()


def test_an_unknown_service_type_is_refused() -> None:
    """With the nearest that is known."""
    assert (
        "did you mean `std_srvs/SetBool`?"
        in refused(SERVICE.replace("std_srvs/SetBool", "std_srvs/SetBol"))[0].text
    )


# Names


BAD_NAMES = [
    ("a() {" + on("/t") + "} a() {" + on("/t") + "}", "there is another specification `a`"),
    ("a() {" + on("/t") + on("/u") + "}", "the event `e` occurs twice"),
    ("a() { int n; int n;" + on("/t") + "}", "`n` is declared twice"),
    (
        "a() { int f() { return 1; } int f() { return 2; }" + on("/t") + "}",
        "the function `f` is declared twice",
    ),
    ("a() { init() { } init() { }" + on("/t") + "}", "`init` occurs twice"),
    (
        "revisions() {" + on("/t") + "}",
        "no specification can be called `revisions`: over REST /v1/monitors/revisions is their history",
    ),
    ("hodl a() {" + on("/t") + "}", "`hodl` is no modifier of a specification; did you mean `hold`?"),
    ("a() { int n; }", "the specification `a` has no event"),
    ("a() {" + on("t") + "}", "`t` is no global name; write `/t`"),
    ("a() {" + on("~t") + "}", "`~t` is no global name"),
]


@pytest.mark.parametrize(("text", "reason"), BAD_NAMES)
def test_a_name_that_cannot_be(text: str, reason: str) -> None:
    """Names that clash or are unknown are refused."""
    assert any(reason in finding.text for finding in refused(text))


def test_time_does_not_pass_for_a_disabled_monitor() -> None:
    """A deadline that passed while it was disabled is not told; time bounds begin anew."""
    monitors = load("a() {" + on("/t") + TIMED + "}")
    monitors.process("/t", number(0), SECOND)
    monitors.switch({"a": False}, 2 * SECOND)
    assert monitors.advance(10 * SECOND) == []
    monitors.switch({"a": True}, 10 * SECOND)
    assert monitors.process("/t", number(0), 11 * SECOND).before == ()


def test_init_of_an_unchanged_specification_does_not_run_again() -> None:
    """A swap is nothing to what stays: no `init`, no output; a new one may read its variables in `init`."""
    kept = 'a() { int n = 1; init() { ROS_INFO("again"); }' + on("/t", "e", "n++;") + "}"
    monitors = load(kept)
    monitors.process("/t", number(0), 1)
    new = 'b() { int m; init() { m = n; ROS_INFO("%d", m); }' + on("/u") + "}"
    _, outcome = replaced(monitors, {"a.rv": kept, "b.rv": new}, definitions(), 2)
    assert printed(outcome) == ["2"]


def test_a_changed_message_type_begins_anew() -> None:
    """Values of a type that is another now are not kept."""
    text = "a() { own::T v; int n; event e(int x) /t own/T '{x:x}' { n++; ROS_INFO(\"%d\", n); } }"
    first = Definitions.from_files({"own/T.msg": "int32 x\n"})
    monitors = MonitorSet.of(compiled_from({"x.rv": text}, first))
    monitors.start(0)
    monitors.process("/t", b"\1\0\0\0", 1)
    same, _ = replaced(monitors, {"x.rv": text}, Definitions.from_files({"own/T.msg": "int32 x\n"}), 2)
    assert printed(same.process("/t", b"\1\0\0\0", 3)) == ["2"]
    other, _ = replaced(
        monitors, {"x.rv": text}, Definitions.from_files({"own/T.msg": "int32 y\nint32 x\n"}), 2
    )
    assert printed(other.process("/t", b"\1\0\0\0" * 2, 3)) == ["1"]


def test_only_what_uses_a_changed_message_type_begins_anew() -> None:
    """However deep it is in it, and however it is named; an unrelated definition ends no state."""
    texts = {
        "deep": "nested() { int n; event e() /a own/Outer '{}' { n++; ROS_INFO(\"%d\", n); } }",
        "kept": "kept() { int n; event e() /b own/Other '{}' { n++; ROS_INFO(\"%d\", n); } }",
        "value": "value() { own::T v; int n; event e() /c own/Other '{}' { n++; ROS_INFO(\"%d\", n); } }",
    }
    files = {"own/T.msg": "int32 x\n", "own/Outer.msg": "own/T[] all\n", "own/Other.msg": "int32 x\n"}
    monitors = MonitorSet.of(compiled_from(texts, Definitions.from_files(files)))
    monitors.start(0)
    for topic in ("/a", "/b", "/c"):
        monitors.process(topic, b"\0\0\0\0", 1)
    files["own/T.msg"] = "int32 y\nint32 x\n"
    other, _ = replaced(monitors, texts, Definitions.from_files(files), 2)
    assert other.began == ("nested", "value")
    counts = [printed(other.process(topic, b"\0\0\0\0", 3)) for topic in ("/a", "/b", "/c")]
    assert counts == [["1"], ["2"], ["1"]]


def test_only_an_operator_lets_the_topics_of_a_held_monitor_go_on() -> None:
    """Neither an edit of it, nor of another, nor another definition of a message does; it may be declared otherwise."""
    text = "hold a() {" + on("/t", "e", 'ROS_INFO("first");') + "} hold b() {" + on("/u") + "}"
    monitors = load(text)
    monitors.start(0, restarted=True)
    monitors.resume("b")
    edited, _ = replaced(monitors, {"x.rv": text.replace("first", "second")}, definitions(), 1)
    assert (edited.monitor("a").held, edited.monitor("b").held) == (True, False)
    assert edited.process("/t", number(0), 1).result == "dropped"
    freed, _ = replaced(
        edited, {"x.rv": text.replace("first", "second").replace("hold a", "a")}, definitions(), 2
    )
    assert freed.process("/t", number(0), 3).result == "passed"
