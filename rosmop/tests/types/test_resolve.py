import pytest

from rosmop.form.findings import Position, SpecificationError
from rosmop.tests.acting import definitions
from rosmop.text import tree
from rosmop.types import value_types
from rosmop.types.messages import MessageTypes
from rosmop.types.resolve import resolve
from rosmop.types.value_types import Type

HERE = Position("x.rv", 1, 1)

SPELLINGS = [
    ("int", value_types.INT),
    ("signed", value_types.INT),
    ("unsigned", value_types.UINT),
    ("unsigned int", value_types.UINT),
    ("int unsigned", value_types.UINT),
    ("long", value_types.LONG),
    ("long long", value_types.LONG),
    ("long long int", value_types.LONG),
    ("unsigned long long", value_types.ULONG),
    ("short int", value_types.INT16),
    ("unsigned short", value_types.UINT16),
    ("char", value_types.CHAR),
    ("signed char", value_types.INT8),
    ("unsigned char", value_types.UINT8),
    ("bool", value_types.BOOL),
    ("float", value_types.FLOAT),
    ("double", value_types.DOUBLE),
    ("std string", value_types.STRING),
    ("string", value_types.STRING),
    ("std uint8_t", value_types.UINT8),
    ("size_t", value_types.ULONG),
    ("int64_t", value_types.LONG),
    ("ros Time", value_types.TIME),
    ("ros Duration", value_types.DURATION),
    ("geometry_msgs Twist", value_types.RecordType("geometry_msgs/Twist")),
]


@pytest.mark.parametrize(("words", "kind"), SPELLINGS)
def test_a_spelling(words: str, kind: Type) -> None:
    assert resolve(tree.TypeName(HERE, tuple(words.split())), MessageTypes(definitions())) == kind


REFUSED = [
    ("int int", "`int int` is not a type"),
    ("long long long", "is not a type"),
    ("unsigned signed", "is not a type"),
    ("char int", "is not a type"),
    ("unsigned double", "`unsigned double` is not a type"),
    ("state", "unknown type `state`"),
    ("float64", "ROS's float64 is `double` in C++"),
    ("float32", "ROS's float32 is `float` in C++"),
    ("uint", "unknown type `uint`; write `unsigned int`"),
    ("uint8", "ROS's uint8 is `uint8_t` in C++"),
    ("time", "ROS's time is `ros::Time` in C++"),
    ("strin", "unknown type `strin`; did you mean `string`?"),
    ("std deque", "unknown type `std::deque`; use a `std::vector`"),
    ("std foo", "unknown type `std::foo`"),
    ("geometry_msgs Twit", "did you mean `geometry_msgs/Twist`?"),
]


@pytest.mark.parametrize(("words", "text"), REFUSED)
def test_an_invalid_spelling(words: str, text: str) -> None:
    with pytest.raises(SpecificationError) as caught:
        resolve(tree.TypeName(HERE, tuple(words.split())), MessageTypes(definitions()))
    assert text in caught.value.findings[0].text
