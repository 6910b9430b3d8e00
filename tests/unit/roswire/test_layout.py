import struct
from itertools import pairwise
from typing import Any

import pytest

from roswire.definitions import Definitions
from roswire.message_layout import ArrayPart, FieldLocation, FixedField, FixedPart, MessageLayout, StringPart
from roswire.message_text import PRIMITIVES

Values = dict[str, Any]


def read(layout: MessageLayout, data: bytes, position: int) -> tuple[Values, int]:
    values: Values = {}
    for part in layout.parts:
        match part:
            case FixedPart(size, leaves):
                for leaf in leaves:
                    values[leaf.path] = read_leaf(leaf, data, position + leaf.offset)
                position += size
            case StringPart(path):
                values[path], position = read_string(data, position)
            case ArrayPart(path, _, count):
                if count is None:
                    (count,) = struct.unpack_from("<I", data, position)
                    position += 4
                values[path] = []
                for _ in range(count):
                    item, position = read_element(part, data, position)
                    values[path].append(item)
    return values, position


def read_leaf(leaf: FixedField, data: bytes, position: int) -> Any:
    if leaf.count is None:
        return primitive(leaf.type, data, position)
    if leaf.layout is not None:
        assert leaf.layout.size is not None
        return [
            read(leaf.layout, data, position + leaf.layout.size * index)[0] for index in range(leaf.count)
        ]
    size = PRIMITIVES[leaf.type][1]
    return [primitive(leaf.type, data, position + size * index) for index in range(leaf.count)]


def read_element(part: ArrayPart, data: bytes, position: int) -> tuple[Any, int]:
    if part.layout is not None:
        values, end = read(part.layout, data, position)
        assert part.element_size in (None, end - position)
        return values, end
    if part.type == "string":
        return read_string(data, position)
    assert part.element_size == PRIMITIVES[part.type][1]
    return primitive(part.type, data, position), position + part.element_size


def read_string(data: bytes, position: int) -> tuple[str, int]:
    (size,) = struct.unpack_from("<I", data, position)
    return data[position + 4 : position + 4 + size].decode(), position + 4 + size


def primitive(type_name: str, data: bytes, position: int) -> Any:
    values = struct.unpack_from("<" + PRIMITIVES[type_name][0], data, position)
    return list(values) if len(values) > 1 else values[0]


def nested(values: Values) -> Values:
    result: Values = {}
    for path, value in values.items():
        *outer, last = path.split(".")
        place = result
        for name in outer:
            place = place.setdefault(name, {})
        place[last] = (
            [nested(item) if isinstance(item, dict) else item for item in value]
            if isinstance(value, list)
            else value
        )
    return result


def without_empty(value: Any) -> Any:
    if isinstance(value, dict):
        return {name: without_empty(item) for name, item in value.items() if item != {}}
    if isinstance(value, list):
        return [without_empty(item) for item in value]
    return value


@pytest.mark.nightly
def test_messages_of_genpy_are_read_by_their_layout(genpy_types: dict[str, dict[str, Any]]) -> None:
    read_types = 0
    for name, entry in genpy_types.items():
        if entry["kind"] != "msg":
            continue
        layout = Definitions.from_full_text(name, entry["text"]).layout(name)
        data = bytes.fromhex(entry["bytes"])
        values, end = read(layout, data, 0)
        assert end == len(data), name
        assert nested(values) == without_empty(entry["values"]), name
        assert layout.size in (None, len(data))
        assert layout.minimum <= len(data)
        read_types += 1
    assert read_types > 100


def test_fixed_parts_are_never_neighbours(standard: Definitions) -> None:
    for name in standard.message_types:
        parts = standard.layout(name).parts
        for part, following in pairwise(parts):
            assert not (isinstance(part, FixedPart) and isinstance(following, FixedPart)), name
        for part in parts:
            if isinstance(part, FixedPart):
                ends = [0, *(leaf.offset + leaf.size for leaf in part.leaves)]
                assert ends == [*(leaf.offset for leaf in part.leaves), part.size]


def test_places_find_fields_by_path(standard: Definitions) -> None:
    places = standard.layout("geometry_msgs/PoseWithCovarianceStamped").places
    assert places["header.frame_id"] == FieldLocation(1, StringPart("header.frame_id"))
    assert places["pose.pose.orientation.w"] == FieldLocation(
        2, FixedField("pose.pose.orientation.w", "float64", 48, 8)
    )
    assert places["pose.covariance"] == FieldLocation(
        2, FixedField("pose.covariance", "float64", 56, 288, 36)
    )
    assert "pose" not in places
    assert "pose.pose.position.q" not in places
    path = standard.layout("nav_msgs/Path").places["poses"].item
    assert path == ArrayPart(
        "poses", "geometry_msgs/PoseStamped", None, None, standard.layout("geometry_msgs/PoseStamped")
    )


def test_arrays_of_every_kind() -> None:
    definitions = Definitions.from_files(
        {
            "a/A.msg": "B[2] b\nint16[3] i\nstring[2] s\nC[2] c\nuint8[] d\nB[] e\ntime[] t",
            "a/B.msg": "int8 x\nint32 y",
            "a/C.msg": "string s\nint8 z",
        }
    )
    layout = definitions.layout("a/A")
    b, c = definitions.layout("a/B"), definitions.layout("a/C")
    assert layout.parts == (
        FixedPart(16, (FixedField("b", "a/B", 0, 10, 2, b), FixedField("i", "int16", 10, 6, 3))),
        ArrayPart("s", "string", 2, None),
        ArrayPart("c", "a/C", 2, None, c),
        ArrayPart("d", "uint8", None, 1),
        ArrayPart("e", "a/B", None, 5, b),
        ArrayPart("t", "time", None, 8),
    )
    assert (b.size, c.size, c.minimum) == (5, None, 5)
    assert layout.size is None
    assert layout.minimum == 16 + 2 * 4 + 2 * 5 + 3 * 4


def test_an_empty_message_has_no_parts(standard: Definitions) -> None:
    assert standard.layout("std_msgs/Empty") == MessageLayout((), 0, 0, {})
