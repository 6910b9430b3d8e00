"""Warnings about specifications: what is probably not meant."""

import pytest

from tests.unit.rosmop.acting import load, message

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
