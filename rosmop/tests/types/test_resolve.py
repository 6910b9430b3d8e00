"""Type names of the text: every spelling of C++'s types, and the refusal of all else."""

import pytest

from rosmop.form.positions import Position
from rosmop.tests.acting import definitions
from rosmop.text import tree
from rosmop.text.errors import SpecificationError
from rosmop.types import kinds
from rosmop.types.kinds import Type
from rosmop.types.messages import Messages
from rosmop.types.resolve import resolve

HERE = Position("x.rv", 1, 1)

SPELLINGS = [
    ("int", kinds.INT),
    ("signed", kinds.INT),
    ("unsigned", kinds.UINT),
    ("unsigned int", kinds.UINT),
    ("int unsigned", kinds.UINT),
    ("long", kinds.LONG),
    ("long long", kinds.LONG),
    ("long long int", kinds.LONG),
    ("unsigned long long", kinds.ULONG),
    ("short int", kinds.INT16),
    ("unsigned short", kinds.UINT16),
    ("char", kinds.CHAR),
    ("signed char", kinds.INT8),
    ("unsigned char", kinds.UINT8),
    ("bool", kinds.BOOL),
    ("float", kinds.FLOAT),
    ("double", kinds.DOUBLE),
    ("std string", kinds.STRING),
    ("string", kinds.STRING),
    ("std uint8_t", kinds.UINT8),
    ("size_t", kinds.ULONG),
    ("int64_t", kinds.LONG),
    ("ros Time", kinds.TIME),
    ("ros Duration", kinds.DURATION),
    ("geometry_msgs Twist", kinds.Record("geometry_msgs/Twist")),
]


@pytest.mark.parametrize(("words", "kind"), SPELLINGS)
def test_a_spelling(words: str, kind: Type) -> None:
    """Each spelling is its type."""
    assert resolve(tree.TypeName(HERE, tuple(words.split())), Messages(definitions())) == kind


REFUSED = [
    ("int int", "`int int` is no type"),
    ("long long long", "is no type"),
    ("unsigned signed", "is no type"),
    ("char int", "is no type"),
    ("unsigned double", "`unsigned double` is no type"),
    ("state", "there is no type `state`"),
    ("float64", "ROS's float64 is `double` in C++"),
    ("float32", "ROS's float32 is `float` in C++"),
    ("uint", "there is no type `uint`; write `unsigned int`"),
    ("uint8", "ROS's uint8 is `uint8_t` in C++"),
    ("time", "ROS's time is `ros::Time` in C++"),
    ("strin", "there is no type `strin`; did you mean `string`?"),
    ("std deque", "there is no type `std::deque`; use a `std::vector`"),
    ("std foo", "there is no type `std::foo`"),
    ("geometry_msgs Twit", "did you mean `geometry_msgs/Twist`?"),
]


@pytest.mark.parametrize(("words", "text"), REFUSED)
def test_a_spelling_that_is_none(words: str, text: str) -> None:
    """What is no type is refused, with what is near."""
    with pytest.raises(SpecificationError) as caught:
        resolve(tree.TypeName(HERE, tuple(words.split())), Messages(definitions()))
    assert text in caught.value.findings[0].text
