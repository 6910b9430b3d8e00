"""What is enforced by publishing, and what `rosrv monitor check` says of enforcement."""

import pytest

from rosmop.check.sources import compiled_from
from rosmop.run.engine import MonitorSet
from rosmop.run.outcomes import Outcome
from rosmop.tests.acting import definitions, load
from rosmop.text.errors import SpecificationError

EVENTS = """event bumped() /bumper std_msgs/Empty '{}' { }
    event stopped() /stop std_msgs/Empty '{}' { }"""
STOP = "stop_robot() { geometry_msgs::Twist still; PUBLISH(/cmd_vel, geometry_msgs/Twist, still); }"
PROPERTY = "pattern: globally: bumped causes stopped within 500ms enforced by stop_robot"
MS = 1_000_000


def guard(
    *, functions: str = STOP, property_text: str = PROPERTY, handler: str = "@enforced { late++; }"
) -> str:
    """A specification with one property."""
    return f"guard() {{ int late = 0; {functions} {EVENTS} {property_text} {handler} }}"


def told(outcome: Outcome) -> tuple[int, list[str], list[str]]:
    """When, which categories, what was published."""
    return outcome.time, [one.category for one in outcome.verdicts], [one.topic for one in outcome.published]


def test_the_remedy_is_published_at_the_deadline_again_and_again() -> None:
    """Once for each time that the answer does not come, without a message; never when it comes."""
    monitors = load(guard())
    monitors.start(0)
    monitors.process("/bumper", b"", 0)
    monitors.process("/stop", b"", 500 * MS)
    assert monitors.advance(1000 * MS) == []
    for start in (2000 * MS, 4000 * MS):
        monitors.process("/bumper", b"", start)
        monitors.process("/bumper", b"", start + 100 * MS)
        assert monitors.advance(start + 500 * MS) == []
        (outcome,) = monitors.advance(start + 501 * MS)
        assert told(outcome) == (start + 500 * MS, ["enforced"], ["/cmd_vel"])
        assert outcome.timer == "guard.deadline"
        assert monitors.advance(start + 1900 * MS) == []
    assert monitors.value("guard", "late") == 2


def test_without_a_handler_of_its_own() -> None:
    """It is published all the same."""
    monitors = load(guard(handler="@violation { late++; }"))
    monitors.start(0)
    monitors.process("/bumper", b"", 0)
    (outcome,) = monitors.advance(600 * MS)
    assert told(outcome) == (500 * MS, ["enforced"], ["/cmd_vel"])
    assert monitors.value("guard", "late") == 0
    assert monitors.publications == {"/cmd_vel": "geometry_msgs/Twist"}


def test_on_trial_it_says_what_it_would_have_published() -> None:
    """In the outcome of the trial; nothing is published by the others."""
    monitors = MonitorSet.of(compiled_from({"a.rv": guard()}, definitions()), trials=["guard"])
    monitors.start(0)
    assert monitors.process("/bumper", b"", 0).result == "passed"
    for tapped in monitors.tapped:
        tapped.give()
    (trial,) = monitors.trials
    assert [told(one) for one in trial.advance(600 * MS)] == [(500 * MS, ["enforced"], ["/cmd_vel"])]
    assert monitors.advance(600 * MS) == []


def test_the_message_that_closes_the_scope_may_be_dropped() -> None:
    """Then only it can bring the violation."""
    text = PROPERTY.replace("globally", "until stopped").replace("causes stopped", "causes bumped")
    assert load(guard(property_text=text, handler="@violation { DROP; }"))


def test_at_the_deadline_there_is_no_message_to_drop() -> None:
    """`DROP` in the handler is refused."""
    with pytest.raises(SpecificationError, match="decided by a deadline"):
        load(guard(handler="@enforced { DROP; }"))


@pytest.mark.parametrize(
    ("functions", "finding"),
    [
        ("stop_robots() { }", "there is no function `stop_robot`; did you mean `stop_robots`?"),
        ("stop_robot() { late++; }", "`stop_robot` publishes nothing; write `PUBLISH(…)` in it"),
        ("stop_robot(int n) { late = n; }", "`stop_robot` takes parameters; nobody gives them at a deadline"),
    ],
)
def test_what_is_no_remedy(functions: str, finding: str) -> None:
    """It is refused, where its name stands."""
    with pytest.raises(SpecificationError) as refused:
        load(guard(functions=functions))
    (found,) = refused.value.findings
    assert found.text == finding
    line = guard(functions=functions).splitlines()[found.position.line - 1]
    assert line[found.position.column - 1 :].startswith("stop_robot @")


def test_a_remedy_that_calls_what_publishes() -> None:
    """A function that is called publishes for it."""
    assert load(guard(functions=f"{STOP.replace('stop_robot', 'halt')} stop_robot() {{ halt(); }}"))


@pytest.mark.parametrize(
    ("text", "expected"),
    [
        (PROPERTY, "enforced: at the deadline stop_robot publishes what was due (/cmd_vel)"),
        ("pattern: globally: some bumped within 1s", "it takes `enforced by f` behind `within`"),
        (
            "mtl: bumped => eventually[0,1s] stopped",
            "it takes a `pattern: … causes … within … enforced by f`",
        ),
        ("mtl: bumped => always[0,1s] !stopped", "can be enforced: @violation may drop"),
        ("ltl: [](bumped => o !stopped)", "may drop the message that brings it about (stopped)"),
        ("ptltl: stopped => <*> bumped", "the message that brings it about (stopped); to enforce it write"),
        ("ptltl: stopped => <*> bumped", "`@violation { DROP; }`; a dropped message has not happened for it"),
        ("ptltl: !bumped", "may drop the message that brings it about (bumped)"),
        ("pattern: globally: bumped causes stopped within 1s", "no drop makes `stopped` come"),
        ("ere: bumped stopped", "a dropped message counts for it"),
        ("ltl: [] <> bumped", "nothing to enforce: no trace leads to @violation"),
        ("ere: bumped stopped", "@fail may drop the message that brings it about (bumped, stopped)"),
    ],
)
def test_what_is_said_of_enforcement(text: str, expected: str) -> None:
    """Whether it can be enforced, by what, or what it would take."""
    (monitor,) = load(guard(property_text=text, handler=f"@{_bad(text)} {{ }}")).monitors
    assert expected in monitor.properties[0].code.enforcement


def test_a_reset_beside_a_drop_is_of_no_use() -> None:
    """For a formula the message has not happened, so the author is warned; a machine begins anew."""
    reset = "@violation { DROP; __RESET; }"
    (warning,) = load(guard(property_text="ptltl: stopped => <*> bumped", handler=reset)).warnings
    assert "when @violation drops the message, `__RESET;` does nothing" in warning.text
    assert not load(guard(property_text="ere: bumped stopped", handler="@match { DROP; __RESET; }")).warnings


def _bad(text: str) -> str:
    return "fail" if text.startswith("ere") else "violation"


def test_a_timer_cannot_be_dropped() -> None:
    """What it would take is said."""
    text = f"guard() {{ {EVENTS} event tick() every 1s {{ }} ptltl: tick => (*) bumped @violation {{ }} }}"
    (monitor,) = load(text).monitors
    said = monitor.properties[0].code.enforcement
    assert said.startswith("cannot be enforced by dropping: the timer `tick` can bring @violation about")
    assert said.endswith("it takes an event on a topic for the timer")
