import pytest

from rosmop.types import value_types
from rosmop.types.value_types import Type

COMMON = [
    (value_types.BOOL, value_types.BOOL, value_types.INT),
    (value_types.CHAR, value_types.UINT16, value_types.INT),
    (value_types.INT, value_types.UINT, value_types.UINT),
    (value_types.UINT, value_types.LONG, value_types.LONG),
    (value_types.LONG, value_types.ULONG, value_types.ULONG),
    (value_types.INT, value_types.ULONG, value_types.ULONG),
    (value_types.INT, value_types.FLOAT, value_types.FLOAT),
    (value_types.ULONG, value_types.FLOAT, value_types.FLOAT),
    (value_types.FLOAT, value_types.DOUBLE, value_types.DOUBLE),
]


@pytest.mark.parametrize(("left", "right", "result"), COMMON)
def test_the_common_type_of_two_numbers(left: Type, right: Type, result: Type) -> None:
    assert value_types.common(left, right) == value_types.common(right, left) == result


def test_integers_of_one_width_and_sign_are_one_type() -> None:
    assert value_types.IntegerType(32, True, "int32_t") == value_types.INT
    assert value_types.CHAR != value_types.UINT8
    assert len({value_types.IntegerType(8, True, "x"), value_types.CHAR, value_types.INT8}) == 1


CONVERTIBLE = [
    (value_types.DOUBLE, value_types.BOOL, True),
    (value_types.STRING, value_types.INT, False),
    (value_types.INT, value_types.STRING, False),
    (value_types.CHARACTERS, value_types.STRING, True),
    (value_types.TIME, value_types.DURATION, False),
    (value_types.TIME, value_types.DOUBLE, False),
    (value_types.VectorType(value_types.INT), value_types.VectorType(value_types.INT, 3), True),
    (value_types.VectorType(value_types.INT, 2), value_types.VectorType(value_types.INT, 3), False),
    (value_types.VectorType(value_types.INT), value_types.VectorType(value_types.DOUBLE), False),
    (value_types.VectorType(value_types.UINT8), value_types.VectorType(value_types.BOOL), True),
    (value_types.RecordType("a/B"), value_types.RecordType("a/B"), True),
    (value_types.RecordType("a/B"), value_types.RecordType("a/C"), False),
    (value_types.VOID, value_types.INT, False),
]


@pytest.mark.parametrize(("source", "target", "possible"), CONVERTIBLE)
def test_types_that_can_be_assigned(source: Type, target: Type, possible: bool) -> None:
    assert value_types.convertible(source, target) is possible


@pytest.mark.parametrize(
    ("kind", "text"),
    [
        (value_types.ULONG, "unsigned long"),
        (value_types.VectorType(value_types.STRING), "std::vector<std::string>"),
        (value_types.VectorType(value_types.DOUBLE, 36), "double[36]"),
        (value_types.RecordType("geometry_msgs/Twist"), "geometry_msgs::Twist"),
        (value_types.CHARACTERS, "char *"),
    ],
)
def test_a_type_is_written_as_in_cpp(kind: Type, text: str) -> None:
    assert str(kind) == text
