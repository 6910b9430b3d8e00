import struct
from collections.abc import Sequence

import pytest

from rosmop.check.expressions import MAX_NOTED
from rosmop.check.sources import compiled_from
from rosmop.run.engine import MonitorSet
from rosmop.run.outcomes import Margin
from rosmop.tests.on_module import on_module
from roswire.standard import standard_definitions

NEAR = """near() {
    const double limit = 7;
    bool high(int n) { return n > limit; }
    event e(int x) /t std_msgs/Int32 '{data:x}' when (x >= 3) {
        for (int i = 0; i < 3; i++) { }
        if (high(x) || x < 5) { x = x + 1; }
        if (3 < 4 || x == 4) { }
    }
}
"""


def started(text: str, *, margins: bool = True) -> MonitorSet:
    monitors = on_module(compiled_from({"a.rv": text}, standard_definitions(), margins=margins))
    monitors.start(0)
    return monitors


def give(monitors: MonitorSet, form: str, *values: int | float, walking: bool = True) -> list[str]:
    judge = monitors.judge if walking else monitors.process
    return [
        judge("/t", bytearray(struct.pack(form, value)), time).result for time, value in enumerate(values, 1)
    ]


def said(margins: Sequence[Margin]) -> list[tuple[int, bool, float, float, float | None]]:
    return [
        (margin.position.line, margin.holds, margin.left, margin.right, margin.threshold_at)
        for margin in sorted(margins, key=lambda one: (one.position, not one.holds))
    ]


@pytest.mark.parametrize("walking", [True, False])
def test_the_nearest_on_both_sides_since_it_was_asked_last(walking: bool) -> None:
    monitors = started(NEAR)
    assert (monitors.lane("/t") is not None) is True
    give(monitors, "<i", 1, 9, 5, walking=walking)
    assert said([*monitors.take_margins()]) == [(3, True, 9, 7, 9), (3, False, 5, 7, 5), (6, False, 5, 5, 5)]
    assert not [*monitors.take_margins()]
    give(monitors, "<i", 20, walking=walking)
    assert said([*monitors.take_margins()]) == [(3, True, 20, 7, 20)]


def test_answers_are_those_of_the_text_as_it_is() -> None:
    """Large integers that a double cannot distinguish, unsigned integers and NaN are compared as in C++."""
    text = """big() { event e(%s x) /t std_msgs/%s '{data:x}' { if (x %s %s) { return; } } }"""
    for kind, message, code, operator, side, values in (
        ("uint64_t", "UInt64", "<Q", ">", "18446744073709551614u", (2**64 - 1, 2**64 - 2, 0)),
        ("int64_t", "Int64", "<q", "<", "-9223372036854775807", (-(2**63), -(2**63) + 1, 5)),
        ("int", "Int32", "<i", ">=", "2u", (-1, 2, 1)),
        ("double", "Float64", "<d", "<=", "0.5", (float("nan"), float("inf"), 0.5)),
    ):
        source = text % (kind, message, operator, side)
        for walking in (True, False):
            noting, plain = started(source), started(source, margins=False)
            assert give(noting, code, *values, walking=walking) == give(plain, code, *values, walking=walking)
            assert all(margin.distance < 2**65 for margin in noting.take_margins())
            assert not [*plain.take_margins()]


def test_a_message_that_faults_is_noted_as_far_as_it_came() -> None:
    text = """s() { int n = 0; event e(int x) /t std_msgs/Int32 '{data:x}' {
        n = n + 1;
        if (x > 10) { x = 1 / (x - 12); }
        if (n > 2) { return; }
    } }"""
    outcomes = {}
    for noting in (True, False):
        monitors = started(text, margins=noting)
        outcomes[noting] = give(monitors, "<i", 1, 12, 11, 3), monitors.value("s", "n")
        noted = said([*monitors.take_margins()])
    assert outcomes[True] == outcomes[False]
    assert not noted
    monitors = started(text)
    give(monitors, "<i", 1, 12)
    assert said([*monitors.take_margins()]) == [
        (3, True, 12, 10, 12),
        (3, False, 1, 10, 1),
        (4, False, 1, 2, 1),
    ]


def test_no_more_is_noted_than_is_bounded() -> None:
    lines = "\n".join(f"if (x > {number}) {{ n = n + 1; }}" for number in range(MAX_NOTED + 9))
    text = f"s() {{ int n = 0; event e(int x) /t std_msgs/Int32 '{{data:x}}' {{\n{lines}\n}} }}"
    monitors = started(text)
    give(monitors, "<i", 20, 100)
    assert len({margin.number for margin in monitors.take_margins()}) == MAX_NOTED
    assert monitors.value("s", "n") == 20 + MAX_NOTED + 9
