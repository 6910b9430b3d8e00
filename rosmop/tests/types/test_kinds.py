"""Types of the language: C++'s usual arithmetic conversions, and what converts into what."""

import pytest

from rosmop.types import kinds
from rosmop.types.kinds import Type

COMMON = [
    (kinds.BOOL, kinds.BOOL, kinds.INT),
    (kinds.CHAR, kinds.UINT16, kinds.INT),
    (kinds.INT, kinds.UINT, kinds.UINT),
    (kinds.UINT, kinds.LONG, kinds.LONG),
    (kinds.LONG, kinds.ULONG, kinds.ULONG),
    (kinds.INT, kinds.ULONG, kinds.ULONG),
    (kinds.INT, kinds.FLOAT, kinds.FLOAT),
    (kinds.ULONG, kinds.FLOAT, kinds.FLOAT),
    (kinds.FLOAT, kinds.DOUBLE, kinds.DOUBLE),
]


@pytest.mark.parametrize(("left", "right", "result"), COMMON)
def test_the_common_type_of_two_numbers(left: Type, right: Type, result: Type) -> None:
    """It is C++'s, whichever stands first."""
    assert kinds.common(left, right) == kinds.common(right, left) == result


def test_integers_of_one_width_and_sign_are_one_type() -> None:
    """`int` and `int32_t` are the same type under two names, `char` and `uint8_t` are not."""
    assert kinds.Integer(32, True, "int32_t") == kinds.INT
    assert kinds.CHAR != kinds.UINT8
    assert len({kinds.Integer(8, True, "x"), kinds.CHAR, kinds.INT8}) == 1


CONVERTIBLE = [
    (kinds.DOUBLE, kinds.BOOL, True),
    (kinds.STRING, kinds.INT, False),
    (kinds.INT, kinds.STRING, False),
    (kinds.CHARACTERS, kinds.STRING, True),
    (kinds.TIME, kinds.DURATION, False),
    (kinds.TIME, kinds.DOUBLE, False),
    (kinds.Vector(kinds.INT), kinds.Vector(kinds.INT, 3), True),
    (kinds.Vector(kinds.INT, 2), kinds.Vector(kinds.INT, 3), False),
    (kinds.Vector(kinds.INT), kinds.Vector(kinds.DOUBLE), False),
    (kinds.Vector(kinds.UINT8), kinds.Vector(kinds.BOOL), True),
    (kinds.Record("a/B"), kinds.Record("a/B"), True),
    (kinds.Record("a/B"), kinds.Record("a/C"), False),
    (kinds.VOID, kinds.INT, False),
]


@pytest.mark.parametrize(("source", "target", "possible"), CONVERTIBLE)
def test_what_can_be_assigned(source: Type, target: Type, possible: bool) -> None:
    """Numbers to numbers, strings to strings, vectors of the same elements, the same message type."""
    assert kinds.convertible(source, target) is possible


@pytest.mark.parametrize(
    ("kind", "text"),
    [
        (kinds.ULONG, "unsigned long"),
        (kinds.Vector(kinds.STRING), "std::vector<std::string>"),
        (kinds.Vector(kinds.DOUBLE, 36), "double[36]"),
        (kinds.Record("geometry_msgs/Twist"), "geometry_msgs::Twist"),
        (kinds.CHARACTERS, "char *"),
    ],
)
def test_a_type_is_written_as_in_cpp(kind: Type, text: str) -> None:
    """Messages to the author speak C++."""
    assert str(kind) == text
