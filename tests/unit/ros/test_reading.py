"""Messages as fields and values, for people."""

import struct

from appliance.ros.definitions import Definitions
from appliance.ros.reading import CUT, MOST_CHARACTERS, MOST_ELEMENTS, read_fields

DEFINITIONS = Definitions.from_files(
    {
        "a/Inner.msg": "float64 x\nstring name\n",
        "a/Outer.msg": "time stamp\nInner[] parts\nuint8[] raw\nbool last\n",
        "a/Many.msg": "int32[] values\n",
    }
)


def inner(x: float, name: str) -> bytes:
    """The bytes of an a/Inner."""
    return struct.pack("<dI", x, len(name)) + name.encode()


OUTER = (
    struct.pack("<III", 5, 250_000_000, 2) + inner(1.5, "one") + inner(2.5, "two") + b"\x02\0\0\0\x0a\xff\x01"
)


def test_fields_are_read_by_their_names() -> None:
    """Times in seconds, bytes as hexadecimal digits."""
    assert read_fields(DEFINITIONS, "a/Outer", OUTER) == {
        "stamp": 5.25,
        "parts": [{"x": 1.5, "name": "one"}, {"x": 2.5, "name": "two"}],
        "raw": "0aff",
        "last": True,
    }


def test_what_is_cut_off_is_read_as_far_as_it_goes() -> None:
    """At every length; nothing that a stranger sends is an exception."""
    for length in range(len(OUTER)):
        fields = read_fields(DEFINITIONS, "a/Outer", OUTER[:length])
        assert fields is not None
        assert CUT in str(fields)
    assert read_fields(DEFINITIONS, "a/Outer", b"\xff" * 200) is not None
    assert read_fields(DEFINITIONS, "a/Nothing", OUTER) is None


def test_long_values_are_shortened() -> None:
    """A log record stays small."""
    many = read_fields(DEFINITIONS, "a/Many", struct.pack("<I100i", 100, *range(100)))
    assert many == {"values": [*range(MOST_ELEMENTS), CUT]}
    assert read_fields(DEFINITIONS, "a/Inner", inner(float("nan"), "")) == {"x": "nan", "name": ""}
    cut = read_fields(DEFINITIONS, "a/Outer", OUTER[:-9])
    assert cut == {"stamp": 5.25, "parts": [{"x": 1.5, "name": "one"}, {"x": 2.5, "name": CUT}]}
    fields = read_fields(DEFINITIONS, "a/Inner", inner(0, "x" * 1000))
    assert fields is not None
    assert fields["name"] == "x" * MOST_CHARACTERS + CUT
