"""`enforced by f` is an error where f's message certainly does not come, and is judged at each deadline elsewhere."""

import pytest

from rosmop.run.engine import MonitorSet
from rosmop.run.outcomes import Outcome
from rosmop.tests.acting import load, message, refused

SECOND = 10**9
BUMP = "event bumped() /bumper std_msgs/Empty '{}' { }"
STOPPED = "event stopped(double x) /cmd_vel geometry_msgs/Twist '{linear.x:x}' when (x == 0) { }"
HALT = "halt() { geometry_msgs::Twist still; PUBLISH(/cmd_vel, geometry_msgs/Twist, still); }"
RULE = "pattern: globally: bumped causes stopped within 500ms enforced by halt"


def guard(halt: str = HALT, stopped: str = STOPPED, rule: str = RULE, more: str = "", order: str = "") -> str:
    handlers = "@enforced { answered++; } @violation { unanswered++; }"
    variables = "int answered = 0; int unanswered = 0; bool on = true; geometry_msgs::Twist kept;"
    return f"guard() {{ {variables} {halt} {BUMP} {stopped} {more} {rule} {handlers} }} {order}"


def later(action: str, more: str = "", name: str = "later") -> str:
    event = f"event drive(double x) /cmd_vel geometry_msgs/Twist '{{linear.x:x}}' {{ {action} }}"
    safe = "safe geometry_msgs/Twist { linear.x:1 } on /cmd_vel every 1s;" if "STOP" in action + more else ""
    return f"{name}() {{ {safe} int n = 0; {event} {more} }}"


FALSE = {
    "another topic": guard(HALT.replace("/cmd_vel", "/cmd_vel_other")),
    "a called function publishes on another topic":
        guard(HALT.replace("/cmd_vel", "/other").replace("halt", "inner") + " halt() { inner(); }"),
    "another type": guard("halt() { std_msgs::Empty m; PUBLISH(/cmd_vel, std_msgs/Empty, m); }"),
    "nothing": guard("halt() { on = false; }"),
    "only a call of a service": guard("halt() { std_srvs::TriggerRequest r; CALL(/halt, std_srvs/Trigger, r); }"),
    "a publication that no path reaches": guard(HALT.replace("PUBLISH", "if (false) PUBLISH")),
    "a publication behind a return": guard(HALT.replace("PUBLISH", "if (1 > 0) { return; } PUBLISH")),
    "a message that the `when` excludes": guard(HALT.replace("PUBLISH", "still.linear.x = 1; PUBLISH")),
    "a message that the pattern excludes": guard(
        stopped="event stopped() /cmd_vel geometry_msgs/Twist '{linear.x:1}' { }"),
    "a shared message that the pattern excludes": guard(
        "halt() { PUBLISH(/cmd_vel, geometry_msgs/Twist, kept); }", more="init() { kept.linear.x = 2; }"),
    "an event of a service": guard(stopped="event stopped() service /halt std_srvs/Trigger request '{}' { }"),
    "a timer": guard(stopped="event stopped() every 1s { }"),
    "a function that faults before": guard(HALT.replace("PUBLISH", "int z = 0; z = 1 / z; PUBLISH")),
    "a later specification drops": guard() + later("return;"),
    "a later specification counts and drops": guard() + later("n++; if (x == 0) { return; }"),
    "a later specification drops by a helper": guard() + later(
        "if (slow(x)) { DROP; }", "bool slow(double v) { return v < 1; }"),
    "a later specification stops": guard() + later("STOP;"),
    "a later specification changes": guard() + later("x = 1;"),
    "the second later specification drops": guard() + later("n++;") + later("return;", name="last"),
    "a property of a later specification drops": guard() + later(
        "", "pattern: globally: no drive @violation { DROP; }"),
    "a state machine of a later specification drops": guard() + later(
        "", "fsm: s [ drive -> s ] @s { DROP; }"),
    "an order puts the dropping one behind": later("return;") + guard(order="order guard < later;"),
    "its own action drops": guard(
        stopped=STOPPED.replace("{ }", "{ return; }"), order="order guard;"),
    "some": guard(HALT.replace("/cmd_vel", "/other"),
        rule="pattern: globally: some stopped within 500ms enforced by halt"),
}  # fmt: skip

TRUE = {
    "as it should be": guard(),
    "through a function": guard(HALT.replace("halt", "inner") + " halt() { inner(); }"),
    "any message": guard(stopped="event stopped() /cmd_vel geometry_msgs/Twist '{}' { }"),
    "one of two messages": guard(HALT.replace("PUBLISH", "geometry_msgs::Twist t; t.linear.x = 1;"
        " PUBLISH(/cmd_vel, geometry_msgs/Twist, t); PUBLISH")),
    "counted and logged": guard(HALT.replace("PUBLISH", 'answered = answered; ROS_WARN("%d", answered); PUBLISH')),
    "a later specification drops other messages": guard() + later("if (x > 1) { return; }"),
    "a later specification changes other messages": guard() + later("if (x > 1) { x = 1; }"),
    "a later specification changes another field": guard() + later("n = n + 1;").replace(
        "(double x)", "(double y)").replace("linear.x:x}' { n", "linear.y:y}' { y = 2; n"),
    "a later specification observes": guard() + later('n++; ROS_INFO("%d", n);'),
    "a property of a later specification observes": guard() + later(
        "", "pattern: globally: no drive @violation { n++; }"),
    "an earlier specification drops": later("return;") + guard(),
    "an order puts the dropping one before": guard(order="order later < guard;") + later("return;"),
    "a later specification drops on another topic": guard() + later("return;").replace("/cmd_vel", "/other"),
}  # fmt: skip

OFF = "event off() /off std_msgs/Empty '{}' { on = false; kept.linear.x = 5; }"
LATER_OFF = "event off() /off std_msgs/Empty '{}' { n = 1; }"

OPEN = {
    "whether it is published": guard(HALT.replace("PUBLISH", "if (on) PUBLISH"), more=OFF),
    "what is published": guard("halt() { PUBLISH(/cmd_vel, geometry_msgs/Twist, kept); }", more=OFF),
    "whether the event accepts it": guard(stopped=STOPPED.replace("x == 0", "x == 0 && on"), more=OFF),
    "whether its own action passes it": guard(
        stopped=STOPPED.replace("{ }", "{ if (!on) { return; } }"), more=OFF, order="order guard;"),
    "whether a later specification drops it": guard() + later("if (n > 0) { return; }", LATER_OFF),
    "whether a later specification changes it": guard() + later("if (n > 0) { x = 3; }", LATER_OFF),
    "whether a later specification stops": guard() + later("if (n > 0) { STOP; }", LATER_OFF),
    "whether a property of a later specification drops it": guard() + later(
        "", LATER_OFF + " pattern: after off: no drive @violation { DROP; }"),
    "whether a handler of a later specification drops it": guard() + later(
        "", LATER_OFF + " ptltl: !drive @violation { if (n > 0) { DROP; } }"),
    "whether the second later specification drops it": guard() + later("n = 0;") + later(
        "if (n > 0) { return; }", LATER_OFF, name="last"),
}  # fmt: skip


def verdicts(outcomes: list[Outcome]) -> list[str]:
    return [verdict.category for outcome in outcomes for verdict in outcome.verdicts]


def said(monitors: MonitorSet) -> str:
    properties = [code for one in monitors.compiled.specifications for code in one.properties]
    return next(code.enforcement for code in properties if code.remedy is not None)


def bump(monitors: MonitorSet, time: int) -> list[str]:
    monitors.process("/bumper", b"", time)
    return verdicts(monitors.advance(time + SECOND))


@pytest.mark.parametrize("name", FALSE)
def test_a_remedy_whose_message_never_comes_is_an_error(name: str) -> None:
    [found] = refused(FALSE[name])
    assert "halt" in found.text or "guard drops" in found.text or "has the type" in found.text, found


@pytest.mark.parametrize("name", TRUE)
def test_a_remedy_whose_message_comes_is_enforced(name: str) -> None:
    monitors = load(TRUE[name])
    assert said(monitors) == "enforced: at the deadline halt publishes the due message (/cmd_vel)"
    assert [bump(monitors, time * SECOND) for time in (1, 3)] == [["enforced"]] * 2
    assert [monitors.value("guard", one) for one in ("answered", "unanswered")] == [2, 0]


@pytest.mark.parametrize("name", OPEN)
@pytest.mark.parametrize("comes", [True, False])
def test_an_answer_that_depends_on_a_state_is_compared_at_the_deadline(name: str, *, comes: bool) -> None:
    monitors = load(OPEN[name])
    assert said(monitors).startswith("enforced, or @violation: at the deadline halt is called to publish ")
    if not comes:
        monitors.process("/off", b"", 1)
    assert bump(monitors, SECOND) == ["enforced" if comes else "violation"]
    assert bump(monitors, 3 * SECOND) == ["enforced" if comes else "violation"]  # each trigger is a new try
    counted = [monitors.value("guard", one) for one in ("answered", "unanswered")]
    assert counted == ([2, 0] if comes else [0, 2])


def test_a_violation_needs_no_handler() -> None:
    text = OPEN["whether a later specification drops it"]
    text = text.replace("@enforced { answered++; } @violation { unanswered++; }", "")
    monitors = load(text)
    monitors.process("/off", b"", 1)
    assert bump(monitors, SECOND) == ["violation"]


def test_a_held_or_disabled_monitor_decides_too() -> None:
    monitors = load(guard() + later("if (x > 5) { return; } n++;"))
    monitors.hold(monitors.monitor("later"), "a test")
    assert bump(monitors, SECOND) == ["violation"]
    monitors.switch({"later": False}, 3 * SECOND)
    assert bump(monitors, 4 * SECOND) == ["enforced"]


def test_an_unanswered_remedy_of_some_is_never_validated() -> None:
    text = guard(
        HALT.replace("PUBLISH", "if (on) PUBLISH"), rule=RULE.replace("bumped causes", "some"), more=OFF
    )
    monitors = load(text.replace("@enforced", '@validation { ROS_INFO("valid"); } @enforced'))
    monitors.process("/off", b"", 1)
    assert verdicts(monitors.advance(SECOND)) == ["violation"]
    assert verdicts([monitors.process("/bumper", b"", 2 * SECOND)]) == ["violation"]


def test_handlers_publish_after_the_verdict_and_are_judged() -> None:
    text = OPEN["whether it is published"].replace(
        "@violation { unanswered++; }",
        "@violation { PUBLISH(/cmd_vel, geometry_msgs/Twist, kept); __RESET; }",
    )
    monitors = load(text + later("n++;"))
    monitors.process("/off", b"", 1)
    assert [bump(monitors, time * SECOND) for time in (1, 3)] == [["violation"]] * 2
    assert monitors.value("later", "n") == 2


GOALS = """goals(std::string id) {
    static std_msgs::String name; static bool on = true; int late = 0;
    void tell() { name.data = on ? id : "nobody"; PUBLISH(/result, std_msgs/String, name); }
    creation event goal(std::string id) /goal std_msgs/String '{data:id}' { }
    event result(std::string id) /result std_msgs/String '{data:id}' { }
    pattern: globally: goal causes result within 1s enforced by tell
    @enforced { ROS_INFO("%s", id.c_str()); } @violation { late++; ROS_WARN("%s %d", id.c_str(), late); }
}
other() { event off() /off std_msgs/Empty '{}' { on = false; } }"""


@pytest.mark.parametrize("order", ["", "order goals;"])
def test_the_message_of_a_slice_answers_its_own_binding_only(order: str) -> None:
    monitors = load(GOALS + order)
    for name in "ab":
        monitors.process("/goal", message("std_msgs/String", data=name), 1)
    outcomes = monitors.advance(2 * SECOND)
    assert [[line.text for line in one.log] for one in outcomes] == [["a"], ["b"]]
    assert verdicts(outcomes) == ["enforced"] * 2
    monitors.process("/off", b"", 3 * SECOND)
    for time in (4, 6):
        monitors.process("/goal", message("std_msgs/String", data="a"), time * SECOND)
        [outcome] = monitors.advance((time + 2) * SECOND)
        assert [verdict.category for verdict in outcome.verdicts] == ["violation"]
        assert outcome.verdicts[0].binding == {"id": "a"}
        assert [line.text for line in outcome.log] == [f"a {time // 2 - 1}"]
