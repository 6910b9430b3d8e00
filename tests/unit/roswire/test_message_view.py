import struct

from roswire.definitions import MAX_DEPTH, Definitions
from roswire.message_view import CUT, MAX_BYTES, MAX_CHARACTERS, MAX_ELEMENTS, read_fields

DEFINITIONS = Definitions.from_files(
    {
        "a/Inner.msg": "float64 x\nstring name\n",
        "a/Outer.msg": "time stamp\nInner[] parts\nuint8[] raw\nbool last\n",
        "a/Many.msg": "int32[] values\n",
    }
)

LONG = Definitions.from_files(
    {
        "a/Long.msg": "float32[] ranges\nfloat32[] intensities\nstring[] names\nuint8[] data\nuint8 last\n",
        "a/Empty.msg": "",
        "a/Empties.msg": "Empty[] values\nuint8 last\n",
        "a/Texts.msg": "string[] values\nuint8 last\n",
    }
)


def inner(x: float, name: str) -> bytes:
    return struct.pack("<dI", x, len(name)) + name.encode()


OUTER = (
    struct.pack("<III", 5, 250_000_000, 2) + inner(1.5, "one") + inner(2.5, "two") + b"\x02\0\0\0\x0a\xff\x01"
)


def test_fields_are_read_by_their_names() -> None:
    assert read_fields(DEFINITIONS, "a/Outer", OUTER) == {
        "stamp": 5.25,
        "parts": [{"x": 1.5, "name": "one"}, {"x": 2.5, "name": "two"}],
        "raw": "0aff",
        "last": True,
    }


def test_a_truncated_message_is_read_to_its_end() -> None:
    for length in range(len(OUTER)):
        fields = read_fields(DEFINITIONS, "a/Outer", OUTER[:length])
        assert fields is not None
        assert CUT in str(fields)
    assert read_fields(DEFINITIONS, "a/Outer", b"\xff" * 200) is not None
    assert read_fields(DEFINITIONS, "a/Nothing", OUTER) is None


def test_long_values_are_shortened() -> None:
    many = read_fields(DEFINITIONS, "a/Many", struct.pack("<I100i", 100, *range(100)))
    assert many == {"values": [*range(MAX_ELEMENTS), f"{CUT} {100 - MAX_ELEMENTS} more"]}
    assert read_fields(DEFINITIONS, "a/Inner", inner(float("nan"), "")) == {"x": "nan", "name": ""}
    cut = read_fields(DEFINITIONS, "a/Outer", OUTER[:-9])
    assert cut == {
        "stamp": 5.25,
        "parts": [{"x": 1.5, "name": "one"}, {"x": 2.5, "name": CUT}],
        "raw": CUT,
        "last": CUT,
    }
    fields = read_fields(DEFINITIONS, "a/Inner", inner(0, "x" * 1000))
    assert fields is not None
    assert fields["name"] == "x" * MAX_CHARACTERS + f"{CUT} {1000 - MAX_CHARACTERS} more"


def test_a_shortened_array_does_not_hide_later_fields() -> None:
    scan = struct.pack("<720f", *range(720))
    names = b"".join(struct.pack("<I", 3) + b"abc" for _ in range(100))
    data = b"".join(struct.pack("<I", 720) + scan for _ in range(2)) + struct.pack("<I", 100) + names
    fields = read_fields(LONG, "a/Long", data + struct.pack("<I", 5000) + b"\1" * 5000 + b"\7")
    assert fields is not None
    assert (
        fields["ranges"]
        == fields["intensities"]
        == [*range(MAX_ELEMENTS), f"{CUT} {720 - MAX_ELEMENTS} more"]
    )
    assert fields["names"] == ["abc"] * MAX_ELEMENTS + [f"{CUT} {100 - MAX_ELEMENTS} more"]
    assert fields["data"] == "01" * MAX_BYTES + f"{CUT} {5000 - MAX_BYTES} more"
    assert fields["last"] == 7


def test_every_field_is_named_where_the_bytes_end() -> None:
    cut = read_fields(LONG, "a/Long", struct.pack("<I", 2**32 - 1) + b"\0" * 4000)
    assert cut is not None
    assert list(cut) == ["ranges", "intensities", "names", "data", "last"]
    assert cut["intensities"] == cut["names"] == cut["data"] == cut["last"] == CUT


def test_fields_that_are_too_many_to_name_are_counted() -> None:
    wide = Definitions.from_files({"a/Wide.msg": "".join(f"int8 f{number}\n" for number in range(1000))})
    fields = read_fields(wide, "a/Wide", b"\0" * 1000)
    assert fields is not None
    assert fields[CUT] == f"{CUT} {1000 - (len(fields) - 1)} more"


def test_large_counts_of_unknown_hosts_take_no_time() -> None:
    empty = read_fields(LONG, "a/Empties", struct.pack("<I", 2**32 - 1) + b"\7")
    assert empty == {"values": [{}] * MAX_ELEMENTS + [f"{CUT} {2**32 - 1 - MAX_ELEMENTS} more"], "last": 7}
    many = read_fields(LONG, "a/Texts", struct.pack("<I", 100_000) + b"\0" * 400_001)
    assert many == {"values": [""] * MAX_ELEMENTS + [f"{CUT} {100_000 - MAX_ELEMENTS} more"], "last": CUT}


def test_only_types_of_bounded_depth_are_read() -> None:
    """A definition of an operator or a publisher does not decide how deep the reader recurses."""
    levels = {f"a/T{level}.msg": f"T{level + 1}[2] x" for level in range(MAX_DEPTH)} | {
        f"a/T{MAX_DEPTH}.msg": "uint8 x",
        "a/Self.msg": "Self[] x",
        "a/Strays.msg": "Missing[] x",
    }
    definitions = Definitions.from_files(levels)
    fields = read_fields(definitions, "a/T1", bytes(4))
    for _ in range(MAX_DEPTH - 1):
        assert fields is not None
        fields = fields["x"][0]
    assert fields == {"x": 0}
    for name in ("a/T0", "a/Self", "a/Strays"):
        assert read_fields(definitions, name, bytes(4)) is None
