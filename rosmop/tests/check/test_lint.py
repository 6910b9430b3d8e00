"""Warnings about specifications: what is probably not meant."""

import pytest

from rosmop.tests.acting import load, message

EVENTS = "event e() /t std_msgs/Int32 '{}' { } event f() /u std_msgs/Int32 '{}' { } "
FORMULAS = [
    ("fsm: s0 [ default s1 ] s1 [ default s0 ] @s1 { }", []),
    ("fsm: s0 [ e -> s1, default s0 ] s1 [ default s0 ] @s1 { }", []),
    ("fsm: s0 [ e -> s1 ] s1 [ e -> s0 ] @s1 { }", ["no property uses the event `f`"]),
    ("fsm: default [ e -> s1 ] s1 [ e -> default ] @s1 { }", ["no property uses the event `f`"]),
    ("ere: e e @match { }", ["no property uses the event `f`"]),
]


@pytest.mark.parametrize(("formula", "warnings"), FORMULAS)
def test_events_that_no_property_uses(formula: str, warnings: list[str]) -> None:
    """An event that nothing names is told; the `default` of a state names all of them."""
    assert [finding.text for finding in load(f"s() {{ {EVENTS} {formula} }}").warnings] == warnings


def test_a_property_without_a_handler_is_taken_and_told() -> None:
    """The grammar of ROSMOP has any number of handlers, none included; messages pass as without the property."""
    loaded = load(f"s() {{ {EVENTS} ere: e f }}")
    assert [finding.text for finding in loaded.warnings] == [
        "nothing comes of this property: it has no handler; write `@fail { … }` behind it"
    ]
    outcome = loaded.process("/u", message("std_msgs/Int32", data=1), 0)
    assert (outcome.result, outcome.verdicts) == ("passed", ())


KEEPING = [
    ("fsm: s0 [ e -> s1, f -> s0 ] s1 [ e -> s1, f -> s1 ] @s1 { }", "", 1),
    ("fsm: s0 [ e -> s1, f -> s0 ] s1 [ e -> s1, f -> s1 ] @s1 { __RESET; }", "", 0),
    ("fsm: s0 [ e -> s1, f -> s0 ] s1 [ e -> s1, f -> s0 ] @s1 { }", "", 0),
    ("ere: e f @fail { }", "", 1),
    ("ltl: [](e => o f) @violation { }", "", 1),
    ("pattern: globally: e causes f within 1s @violation { }", "", 1),
    ("pattern: globally: e causes f within 1s @violation { __RESET; }", "", 0),
    ("ere: e f @match { __RESET; }", 'event t() every 1s { ROS_INFO("still there"); }', 1),
    ("ere: e f @match { __RESET; }", "event t() every 1s { times = times + 1; }", 0),
]


@pytest.mark.parametrize(("formula", "timer", "count"), KEEPING)
def test_what_keeps_slices_for_ever_is_said(formula: str, timer: str, count: int) -> None:
    """Of a parametric specification: an empty handler of what is for good, and a timer that may always act."""
    events = EVENTS.replace("()", "(int n)").replace("'{}'", "'{data:n}'")
    text = f"s(int n) {{ int times = 0; {events} {timer} {formula} }}"
    said = [one.text for one in load(text).warnings if "for ever" in one.text or "never end" in one.text]
    assert len(said) == count
    plain = f"s() {{ int times = 0; {EVENTS} {timer} {formula} }}"
    assert not [one for one in load(plain).warnings if "slice" in one.text]


SLIPS = [
    (
        "if (v = 0.8) { v = 1; }",
        "`=` assigns, and the condition is the value that was assigned; to compare write `==`",
    ),
    ("if (v > 1 && !(n = 2)) { v = 1; }", "`=` assigns"),
    ("while (n = 0) { n++; }", "`=` assigns"),
    ("v = (n = 2) ? 1 : 2;", "`=` assigns"),
    ("v == 3;", "this statement has no effect: `==` compares; to assign write `=`"),
    ("n + 1;", "this statement has no effect; remove it, or assign its value to a variable"),
    ("v;", "this statement has no effect"),
    ("if (v == NAN) { v = 1; }", "`==` with NaN is never true; to find NaN write `std::isnan(…)`"),
    ("if (v != 0.0 * INFINITY) { v = 1; }", "`!=` with NaN is always true"),
    ("if (v < -NAN) { v = 1; }", "`<` with NaN is never true"),
    ("if (v < std::numeric_limits<double>::quiet_NaN()) { v = 1; }", "`<` with NaN is never true"),
    ("if ((n = 3) > 2 && v == 0.8) { v = 1; } n++; f(n); std::cout << v; v += 1; isnan(v);", None),
]


@pytest.mark.parametrize(("body", "warning"), SLIPS)
def test_slips_that_cpp_allows_are_said(body: str, warning: str | None) -> None:
    """An assignment as a condition, a statement without effect, a comparison with NaN: at their place."""
    own = "double v = 0; int n = 0; void f(int k) { n = k; }"
    text = f"s() {{ {own}\nevent e() /t std_msgs/Int32 '{{}}' {{ {body} }} }}"
    said = load(text).warnings
    assert len(said) == (warning is not None)
    for finding in said:
        assert warning is not None
        assert finding.text.startswith(warning)
        assert finding.position.line == 2
