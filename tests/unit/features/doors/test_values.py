import functools
import math
import struct
import tracemalloc
from collections.abc import Sequence
from random import Random
from typing import Any

import cbor2
import msgspec
import pytest
from rosbags.typesys import Stores, get_typestore
from rosbags.typesys.store import Typestore

from appliance.features.doors.cbor_frames import MAX_ITEMS, MAX_NESTING, MAX_NUMBERS, json_of_cbor
from appliance.features.doors.message_reader import MessageValueError
from appliance.features.doors.values import MessageCodec, ValueLimits, cbor
from roswire.definitions import MAX_DEPTH, Definitions
from roswire.errors import DefinitionError
from roswire.message_text import Field
from roswire.standard import standard_definitions

NOW = (1_700_000_000, 5)
LIMITS = ValueLimits(message_bytes=10_000, shown_bytes=1 << 16, values=2_000)


@functools.cache
def standard() -> Definitions:
    return standard_definitions()


@functools.cache
def rosbags() -> Typestore:
    return get_typestore(Stores.ROS1_NOETIC)


def codec(text: str, limits: ValueLimits = LIMITS) -> MessageCodec:
    return MessageCodec(standard().merge(Definitions.from_files({"t/T.msg": text})), "t/T", limits)


def written(text: str, json: str) -> bytes:
    return codec(text).writer.from_json(json.encode(), NOW)


SCALARS: dict[str, Sequence[Any]] = {
    "bool": (False, True),
    "string": ("", "grüße", "base_link"),
    "time": ({"secs": 1, "nsecs": 2}, {"secs": 0, "nsecs": 999_999_999}),
    "duration": ({"secs": -1, "nsecs": 2}, {"secs": 0, "nsecs": 999_999_999}),
    **dict.fromkeys(("float32", "float64"), (0.0, -1.5, 2.0**100)),
    **dict.fromkeys(("byte", "int8", "int16", "int32", "int64"), (0, -128, 127)),
    **dict.fromkeys(("char", "uint8", "uint16", "uint32", "uint64"), (0, 255)),
}


def random_value(random: Random, field: Field) -> Any:
    if not field.is_array:
        return (
            random.choice(SCALARS[field.type])
            if field.type in SCALARS
            else random_message(random, field.type)
        )
    count = random.randrange(3) if field.length is None else field.length
    if field.type in ("uint8", "char"):
        return random.randbytes(count)
    return [random_value(random, Field(field.type, field.name)) for _ in range(count)]


def random_message(random: Random, name: str) -> dict[str, Any]:
    return {field.name: random_value(random, field) for field in standard().message(name).fields}


def as_seen_by_rosbags(message: Any) -> Any:
    if isinstance(message, list):
        return [as_seen_by_rosbags(one) for one in message]
    if hasattr(message, "nanosec"):
        return {"secs": message.sec, "nsecs": message.nanosec}
    if hasattr(message, "__msgtype__"):
        fields = rosbags().fielddefs[message.__msgtype__][1]
        return {
            name: as_seen_by_rosbags(getattr(message, name))
            for name, _kind in fields
            if name != "structure_needs_at_least_one_member"
        }
    if hasattr(message, "tolist"):
        return bytes(message) if message.dtype == "uint8" else message.tolist()
    return message


def test_every_standard_message_survives_json_and_cbor_and_is_what_rosbags_reads() -> None:
    random = Random(49)  # noqa: S311  drawn for a test
    compared = 0
    for name in standard().message_types:
        made = MessageCodec(standard(), name, ValueLimits())
        values = random_message(random, name)
        data = made.writer.from_json(msgspec.json.encode(values), NOW)
        assert made.writer.from_json(json_of_cbor(made.cbor(data)), NOW) == data, name
        assert msgspec.json.decode(made.json(data)) == msgspec.json.decode(msgspec.json.encode(values)), name
        package, _, short = name.partition("/")
        rosbags_name = f"{package}/msg/{short}"
        if rosbags_name in rosbags().fielddefs:
            compared += 1
            assert as_seen_by_rosbags(rosbags().deserialize_ros1(data, rosbags_name)) == values, name
    assert compared > 150


def test_bytes_are_accepted_as_base64_as_numbers_and_as_cbor_bytes() -> None:
    for spelling in ('{"data":"AAEC"}', r'{"data":"AA\nEC\r\n"}', '{"data":[0,1,2]}'):
        assert written("uint8[] data", spelling) == b"\x03\x00\x00\x00\x00\x01\x02"
    for given in (b"\0\1\2", "AAEC", [0, 1, 2], cbor2.CBORTag(64, b"\0\1\2"), cbor2.CBORTag(68, b"\0\1\2")):
        frame = json_of_cbor(cbor2.dumps({"data": given}))
        assert codec("uint8[3] data").writer.from_json(frame, NOW) == b"\0\1\2"


def test_json_has_null_for_what_it_cannot_spell_and_cbor_keeps_it() -> None:
    data = struct.pack("<dd", math.nan, -math.inf)
    made = codec("float64 a\nfloat64 b")
    assert bytes(made.json(data)) == b'{"a":null,"b":null}'
    assert cbor2.loads(made.cbor(data))["b"] == -math.inf
    assert bytes(codec("string s").json(b"\x01\x00\x00\x00\xff")) == '{"s":"\ufffd"}'.encode()


def test_cbor_has_typed_arrays_of_the_bytes_of_the_message() -> None:
    data = struct.pack("<I2f2h", 2, 1.0, 2.0, 3, 4)
    values = cbor2.loads(codec("float32[] f\nint16[2] h").cbor(data))
    assert cbor(values) == cbor2.dumps(
        {"f": cbor2.CBORTag(85, data[4:12]), "h": cbor2.CBORTag(77, data[12:])}
    )


@pytest.mark.parametrize(
    ("given", "stamp"),
    [
        ('{"h":{}}', NOW),
        ('{"h":{"stamp":"now"}}', NOW),
        ('{"h":{"stamp":{"secs":7,"nsecs":8}}}', (7, 8)),
        ('{"h":{"stamp":{"sec":7,"nanosec":8}}}', (7, 8)),
        ('{"h":{"stamp":{"secs":7,"nsecs":2000000001}}}', (9, 1)),
        ('{"h":{"stamp":{}}}', (0, 0)),
        ("{}", (0, 0)),
    ],
)
def test_a_header_without_a_stamp_gets_the_present_time(given: str, stamp: tuple[int, int]) -> None:
    assert struct.unpack_from("<III", written("Header h\nuint8 end", given)) == (0, *stamp)


@pytest.mark.parametrize(
    ("text", "given", "error"),
    [
        ("int8 a", '{"b":1}', "unknown field `b`"),
        ("t/In i\n", '{"i":{"x":{"w":1}}}', "unknown field `w` - at `$.i.x`"),
        ("int8 a", '{"a":128}', "Expected `int` <= 127 - at `$.a`"),
        ("int8 a", '{"a":1.0}', "Expected `int`, got `float` - at `$.a`"),
        ("int8 a", '{"a":true}', "Expected `int`, got `bool` - at `$.a`"),
        ("bool a", '{"a":1}', "Expected `bool`, got `int` - at `$.a`"),
        ("uint64 a", '{"a":18446744073709551616}', "Number out of range - at `$.a`"),
        ("uint64[] a", '{"a":[18446744073709551616]}', "Number out of range - at `$.a`"),
        ("float32 a", '{"a":1e39}', "Number out of range - at `$.a`"),
        ("float64 a", '{"a":1e400}', "Number out of range - at `$.a`"),
        ("float64 a", f'{{"a":{"9" * 5000}}}', "out of range"),
        ("float64 a", '{"a":null}', "Expected `float`, got `null` - at `$.a`"),
        ("float64[3] a", '{"a":[1,2]}', "Expected float64[3], got 2 elements - at `$.a`"),
        ("uint8[2] a", '{"a":"AAEC"}', "Expected uint8[2], got 3 elements - at `$.a`"),
        ("uint8[] a", '{"a":"*"}', "Invalid base64 encoded string - at `$.a`"),
        ("uint8[] a", '{"a":"AAECü"}', "Invalid base64 encoded string - at `$.a`"),
        ("t/Row[] r", '{"r":[{"f":[1]},{"f":[1,2]}]}', "Expected float32[1], got 2 elements - at `$.r[1].f`"),
        ("string a", '{"a":"' + "x" * 10_001 + '"}', "The message has more than 10000 bytes - at `$.a`"),
        ("uint8[1000] a", '{"a":"' + "A" * 10 + '"}', "Invalid base64 encoded string"),
        ("float64[400000000] a", "{}", "The message has more than 10000 bytes - at `$.a`"),
        ("t/Wide[] w", '{"w":[{},{},{}]}', "The message has more than 10000 bytes - at `$.w[2].b`"),
        ("int8 a", "[" * 100_000, "Expected `object`, got `array`"),
        ("int8 a", '{"a":' + "[" * 100_000, "Expected `int`, got `array` - at `$.a`"),
        ("string a", '{"a":"\\ud800"}', "truncated"),
        ("time a", '{"a":5}', "got `int` - at `$.a`"),
        ("time a", '{"a":{"secs":-1}}', "Expected `int` >= 0 - at `$.a.secs`"),
        ("time a", '{"a":{"seconds":1}}', "unknown field `seconds` - at `$.a`"),
    ],
)  # fmt: skip
def test_values_that_do_not_fit_are_an_error_with_the_path(text: str, given: str, error: str) -> None:
    types = {
        "t/T.msg": text,
        "t/In.msg": "geometry_msgs/Point32 x",
        "t/Row.msg": "float32[1] f",
        "t/Wide.msg": "uint8[4000] b",
    }
    made = MessageCodec(standard().merge(Definitions.from_files(types)), "t/T", LIMITS)
    with pytest.raises(MessageValueError) as caught:
        made.writer.from_json(given.encode(), NOW)
    assert "t/T: " in str(caught.value) and error in str(caught.value)


def test_invalid_utf_8_is_an_error_in_words() -> None:
    with pytest.raises(MessageValueError, match="t/T: 'utf-8' codec can't decode"):
        codec("string a").writer.from_json(b'{"a":"\xff"}', NOW)


@pytest.mark.parametrize(
    ("text", "data", "error"),
    [
        ("int32 a", b"\0\0", "ends inside a field"),
        ("int32 a", b"\0\0\0\0\0", "a message of 5 bytes, of which its definition describes 4"),
        ("string a", b"\xff\xff\xff\xffabc", "4294967295 bytes at byte 4 of a message of 7 bytes"),
        ("float64[] a", b"\xff\xff\xff\xff", "34359738360 bytes"),
        ("string[] a", struct.pack("<I", 3000) + bytes(12_000), "too many values"),
        ("std_msgs/Empty[] a", b"\xff\xff\xff\xff", "too many values"),
        ("time[] a", struct.pack("<I", 1000) + bytes(8_000), "too many values"),
        ("int8[] a", struct.pack("<I", 20_000) + bytes(20_000), "too many values"),
        ("string a", struct.pack("<I", 20_000) + bytes(20_000), "too many values"),
        ("uint8[] a", struct.pack("<I", 1 << 16) + bytes(1 << 16), "as JSON or CBOR at most 65536"),
    ],
)
def test_a_hostile_message_takes_neither_time_nor_memory(text: str, data: bytes, error: str) -> None:
    with pytest.raises(MessageValueError, match=error):
        codec(text).json(data)


@pytest.mark.parametrize(
    ("frame", "error"),
    [
        (b"\x9f\x01\xff", "indefinite length at byte 0"),
        (b"\x5f\x41a\xff", "indefinite length at byte 0"),
        (b"\xbf\xff", "indefinite length at byte 0"),
        (b"\x9b" + b"\xff" * 8, "ends inside the value"),
        (b"\xbb" + b"\x7f" * 8, "ends inside the value"),
        (b"\x5b" + b"\xff" * 8 + b"a", "ends inside the value"),
        (b"\x81" * (MAX_NESTING + 1) + b"\0", f"nested deeper than {MAX_NESTING}"),
        (b"\x81" * 1_000_000, f"nested deeper than {MAX_NESTING}"),
        (b"\x9a\x00\x10\x00\x00" + b"\x80" * (1 << 20), f"more than {MAX_ITEMS} values"),
        (cbor2.dumps(2**70), "tag 2"),
        (b"\xd8\x23\x61(", "tag 35"),
        (b"\xd8\x1c\x81\xd8\x1d\x00", "tag 28"),
        (b"\xd8\x55\x01", "tag 85 of a value that is not a byte string"),
        (b"\xd8\x55\x43abc", "a typed array of 3 bytes, which is not a multiple of its elements' 4 bytes"),
        (b"\x61\xff", "not CBOR"),
        (b"\x01\x01", "1 bytes after the end"),
        (b"", "ends at byte 0"),
        (b"\xf8\x20", "unknown kind"),
        (b"\x1c", "unknown kind"),
        (b"\xf7", "unknown kind"),
        (b"\x19\x00", "ends inside the value"),
        (b"\xa1\x80\x01", "a key that is not a text at byte 1"),
    ],
)
def test_a_hostile_cbor_frame_is_an_error_in_words(frame: bytes, error: str) -> None:
    with pytest.raises(MessageValueError, match=error):
        json_of_cbor(frame)


def test_the_scan_accepts_what_cbor2_writes_for_plain_values() -> None:
    several = [1, -1, 2**64 - 1, 1.5, True, None, "x" * 300, b"y" * 70_000]
    plain = {"a": several, "b": {"c": []}, "d": [0] * 300}
    assert json_of_cbor(cbor2.dumps(plain)) == msgspec.json.encode(plain)
    assert json_of_cbor(cbor2.dumps({"nan": math.nan})) == b'{"nan":null}'


@pytest.mark.parametrize(
    ("text", "unit"),
    [
        ("t/P[] a", "{}"),
        ("t/P[] a", '{"x":1.5}'),
        ("float64[] a", "1.5"),
        ("float64[] a", "0"),
        ("int64[] a", "4611686018427387904"),
        ("string[] a", '"ab"'),
        ("string[] a", '"grüße"'),
        ("time[] a", "{}"),
        ("time[] a", '"now"'),
        ("t/L[] a", '{"b":[]}'),
        ("uint8[] a", "255"),
        ("string[] a", '"' + "x" * 5000 + '"'),
    ],
)
def test_the_cost_of_a_text_is_an_upper_bound_of_the_memory_that_it_takes(text: str, unit: str) -> None:
    point, row = "float64 x\nfloat64 y\nfloat64[9] z\nstring s", "int32[] b"
    files = {"t/T.msg": text, "t/P.msg": point, "t/L.msg": row}
    definitions = standard().merge(Definitions.from_files(files))
    writer = MessageCodec(definitions, "t/T", ValueLimits()).writer
    sent = f'{{"a":[{",".join([unit] * min(20_000, 3_000_000 // len(unit)))}]}}'.encode()
    writer.from_json(sent, NOW)
    tracemalloc.start()
    writer.from_json(sent, NOW)
    _taken, peak = tracemalloc.get_traced_memory()
    tracemalloc.stop()
    assert peak < writer.cost(sent)


def test_numbers_of_typed_arrays_are_bounded() -> None:
    array = cbor2.CBORTag(72, bytes(MAX_NUMBERS + 1))
    with pytest.raises(MessageValueError, match=f"more than {MAX_NUMBERS} numbers"):
        json_of_cbor(cbor2.dumps({"op": "publish", "msg": {"data": array}}))
    assert json_of_cbor(cbor2.dumps({"data": cbor2.CBORTag(64, bytes(MAX_NUMBERS + 1))}))


def test_a_codec_serves_the_deepest_permitted_types() -> None:
    """Deeper types cannot be used, however their definition orders them; so no publisher exhausts the stack."""
    levels = 300
    parts = {f"t/D{level}.msg": f"D{level + 1}[] x" for level in range(levels)} | {
        f"t/D{levels}.msg": "uint8 x",
        "t/Root.msg": "".join(f"D{level} f{level}\n" for level in [*range(levels - 40, 0, -40), 0]),
    }
    definitions = Definitions.from_files(parts)
    with pytest.raises(DefinitionError, match="deeper than 64"):
        MessageCodec(definitions, "t/Root", LIMITS)
    deepest = MessageCodec(definitions, f"t/D{levels - MAX_DEPTH + 1}", LIMITS)
    json = '{"x":[' * (MAX_DEPTH - 1) + '{"x":7}' + "]}" * (MAX_DEPTH - 1)
    data = deepest.writer.from_json(json.encode(), NOW)
    assert bytes(deepest.json(data)) == json.encode()
    assert cbor2.loads(deepest.cbor(data)) == msgspec.json.decode(json)
