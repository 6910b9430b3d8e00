import struct
import weakref
from collections.abc import Mapping

import pytest

from appliance.features.doors.client_frames import ClientFrame
from appliance.features.doors.known_types import DoorMessage, KnownType, KnownTypes, SharedFrames
from appliance.features.doors.rosbridge_frames import Compression, publish_frame
from appliance.features.doors.values import ValueLimits
from roswire.definitions import Definitions
from roswire.errors import DefinitionError
from roswire.message_layout import MessageLayout
from roswire.standard import standard_definitions


def header(name: str, text: str) -> dict[str, str]:
    md5sum = Definitions.from_full_text(name, text).md5sum(name)
    return {"type": name, "md5sum": md5sum, "message_definition": text}


@pytest.fixture
def types() -> KnownTypes:
    return KnownTypes(standard_definitions(), ValueLimits())


def test_a_type_of_the_operator_that_cannot_be_used_is_tried_once(
    types: KnownTypes, monkeypatch: pytest.MonkeyPatch
) -> None:
    tried: list[str] = []
    layout = Definitions.layout

    def counted(self: Definitions, name: str) -> MessageLayout:
        tried.append(name)
        return layout(self, name)

    monkeypatch.setattr(Definitions, "layout", counted)
    types.define(Definitions.from_files({"own/Huge.msg": "int64[1000000000] x"}))
    for _message in range(100):
        with pytest.raises(DefinitionError):
            types.message("own/Huge")
    assert len(tried) <= 2


def test_a_definition_counts_for_its_header_only(types: KnownTypes) -> None:
    first = types.learn(header("own/Load", "int8 x"))
    second = types.learn(header("own/Load", "int16 x"))
    assert types.learn(header("own/Load", "int8 x")) is first is not second
    with pytest.raises(DefinitionError, match="not one of ROS's own packages"):
        types.message("own/Load")
    assert types.message("std_msgs/String").codec.name == "std_msgs/String"


@pytest.mark.parametrize("name", [*standard_definitions().message_types[::7], "std_srvs/SetBoolRequest"])
def test_no_header_replaces_a_type_of_ros(types: KnownTypes, name: str) -> None:
    before = types.message(name).full_text
    given = header(name, "int8 forged")
    assert types.learn(given).definitions.message(name).text == "int8 forged"
    assert types.message(name).full_text == before and types.message(name).defined


def test_no_header_replaces_a_type_of_the_operator(types: KnownTypes) -> None:
    types.define(
        Definitions.from_files({"my/State.msg": "int8 level", "my/Set.srv": "bool on\n---\nbool done"})
    )
    for name in ("my/State", "my/SetRequest", "my/SetResponse"):
        types.learn(header(name, "int64 forged"))
    assert types.message("my/State").full_text.strip() == "int8 level"
    assert [one.codec.writer.fields for one in types.service("my/Set")[:2]] == [["on"], ["done"]]


def test_the_text_of_ros_counts_even_if_a_header_has_its_md5sum(types: KnownTypes) -> None:
    given = header("std_msgs/String", "string data  # the robot is safe to touch")
    assert types.learn(given) is types.message("std_msgs/String")


PARTS = f"\n{'=' * 80}\nMSG: own/Part\nint8 x\n{'=' * 80}\nMSG: own/Other\nint8 x"


@pytest.mark.parametrize(
    ("text", "other"),
    [
        ("Part[] a" + PARTS, "Part a" + PARTS),
        ("Part[] a" + PARTS, "Part[3] a" + PARTS),
        ("Part a\nPart b" + PARTS, "Part a\nPart[2] b" + PARTS),
        ("Part a" + PARTS, "Other a" + PARTS),
    ],
)
def test_a_definition_is_not_that_of_an_equal_md5sum(types: KnownTypes, text: str, other: str) -> None:
    one, two = header("own/Load", text), header("own/Load", other)
    assert one["md5sum"] == two["md5sum"]
    known = types.learn(one)
    assert types.learn(two) is not known and types.learn(one) is known
    assert types.key(one) != types.key(two)
    commented = header("own/Load", text.replace("\n", "  # a comment\n", 1))
    assert types.key(commented) == types.key(one)
    assert len(types.take_differing()) == 1
    types.define(Definitions.from_full_text("own/Load", text))
    assert types.learn(one) is types.learn(commented) is types.message("own/Load") is not types.learn(two)
    assert types.learn(one | {"message_definition": ""}) is types.message("own/Load")


@pytest.mark.parametrize(
    ("change", "words"),
    [
        ({"md5sum": "0" * 32}, "does not have its md5sum 00000"),
        ({"message_definition": "own/Other y"}, "own/Other, which is not defined"),
        ({"message_definition": "own/Load y"}, "own/Load contains own/Load"),
        ({"type": "", "message_definition": ""}, "not a message type"),
    ],
)
def test_a_definition_that_cannot_be_used_is_an_error(
    types: KnownTypes, change: dict[str, str], words: str
) -> None:
    with pytest.raises(DefinitionError, match=words):
        types.learn(header("own/Load", "int8 x") | change)


def test_a_type_with_too_large_messages_is_an_error(types: KnownTypes) -> None:
    with pytest.raises(DefinitionError, match="more than 4294967296 bytes"):
        types.learn(header("own/Load", "float64[4000000000] x"))


def test_many_large_definitions_are_forgotten_in_order(types: KnownTypes) -> None:
    large = "\n".join(f"int8 f{number}" for number in range(4000))
    first = weakref.ref(types.learn(header("own/Large0", large)))
    for number in range(1, 15):
        types.learn(header(f"own/Large{number}", large))
    assert first() is None
    assert types.learn(header("own/Large14", large)) is types.learn(header("own/Large14", large))


def test_types_in_use_are_never_parsed_again_and_bound_all_others(types: KnownTypes) -> None:
    large = "\n".join(f"int8 f{number}" for number in range(4000))
    used = []
    with pytest.raises(DefinitionError, match="the types of topics in use take"):
        for number in range(100):
            used.append(types.learn(header(f"own/Large{number}", large)))
    assert 5 < len(used) < 20
    assert types.learn(header("own/Large0", large)) is used[0]
    used.clear()
    assert types.learn(header("own/Large99", large))


def test_a_short_definition_with_a_large_layout_counts_by_its_layout(types: KnownTypes) -> None:
    parts = [f"Part{level} a\nPart{level} b" for level in range(1, 12)] + ["int8 x"]
    text = "".join(f"\n{'=' * 80}\nMSG: own/Part{level}\n{part}" for level, part in enumerate(parts))
    known = types.learn(header("own/Large", f"Part0 a{text}"))
    assert len(text) < 2_000 and known.characters > 100_000


def test_a_definition_that_cannot_be_used_is_parsed_once(
    types: KnownTypes, monkeypatch: pytest.MonkeyPatch
) -> None:
    parsed: list[str] = []
    parse = Definitions.from_full_text

    def counted(name: str, text: str) -> Definitions:
        parsed.append(name)
        return parse(name, text)

    monkeypatch.setattr(Definitions, "from_full_text", counted)
    bad = header("own/Load", "int8 x") | {"md5sum": "0" * 32}
    for _message in range(100):
        with pytest.raises(DefinitionError, match="does not have its md5sum"):
            types.learn(bad)
    assert len(parsed) == 1 + 1
    other = bad | {"message_definition": "int8 y"}  # a failure belongs to the whole header
    with pytest.raises(DefinitionError):
        types.learn(other)
    assert len(parsed) == 3
    types.define(Definitions.from_files({"own/Part.msg": "int8 x"}))
    with pytest.raises(DefinitionError):
        types.learn(bad)
    assert len(parsed) == 4


def test_the_operators_files_define_types_until_they_change(types: KnownTypes) -> None:
    with pytest.raises(DefinitionError, match="rosrv monitor reload"):
        types.service("own/Add")
    for field in ("a", "b"):
        types.define(Definitions.from_files({"own/Add.srv": f"int8 {field}\n---\nint8 sum\n"}))
        assert types.service("own/Add")[0].codec.writer.fields == [field]
    types.define(Definitions.from_files({}))
    with pytest.raises(DefinitionError, match="does not know this service type"):
        types.service("own/Add")
    with pytest.raises(DefinitionError, match="does not know this message type"):
        types.message("own/AddRequest")


def test_a_message_is_encoded_once_for_all_clients_within_bounds(types: KnownTypes) -> None:
    given, learned = header("own/Bytes", "uint8[] x"), list[str]()

    def learn(fields: Mapping[str, str]) -> KnownType:
        learned.append(fields["type"])
        return types.learn(fields)

    def message(size: int) -> DoorMessage:
        return DoorMessage("/x", struct.pack("<I", size) + bytes(size), given, 0, learn, shared)

    def frame(message: DoorMessage, topic: str, compression: Compression) -> ClientFrame:
        return message.frame((topic, compression), publish_frame)

    shared = SharedFrames(most=150_000)
    first = message(10_000)
    for compression in ("none", "cbor"):
        assert frame(first, "/x", compression) is frame(first, "/x", compression)
    assert len(learned) == 2
    assert frame(first, "x", "none") is not frame(first, "/x", "none")
    assert frame(first, "x", "none") is frame(first, "x", "none") and len(learned) == 3
    raw = message(50_000)
    assert frame(raw, "/x", "cbor-raw") is not frame(raw, "/x", "cbor-raw")  # it has the bytes of the message
    for size in (10_000, 10_000, 10_000, 50_000, 90_000):
        assert frame(message(size), "/x", "none")
        assert shared.bytes <= 150_000
    assert frame(first, "/x", "none") and len(learned) == 9  # it is no longer kept
