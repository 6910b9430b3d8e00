import struct
from collections.abc import Mapping

import pytest

from appliance.features.doors.known_types import DoorMessage, KnownTypes, SharedFrames
from appliance.features.doors.png_frames import DoorFrame
from appliance.features.doors.rosbridge_frames import Compression, publish_frame
from appliance.features.doors.values import MessageCodec, ValueLimits
from roswire.definitions import Definitions
from roswire.errors import DefinitionError
from roswire.standard import standard_definitions


def header(name: str, text: str) -> dict[str, str]:
    md5sum = Definitions.from_full_text(name, text).md5sum(name)
    return {"type": name, "md5sum": md5sum, "message_definition": text}


@pytest.fixture
def types() -> KnownTypes:
    return KnownTypes(standard_definitions(), ValueLimits())


def test_a_type_is_known_once_a_publisher_sent_its_definition(types: KnownTypes) -> None:
    with pytest.raises(DefinitionError, match="no publisher of it has been heard"):
        types.message("own/Load")
    first = types.learn(header("own/Load", "int8 x"))
    second = types.learn(header("own/Load", "int16 x"))
    assert types.learn(header("own/Load", "int8 x")) is first
    assert types.message("own/Load")[0] is second
    assert types.message("std_msgs/String")[0].name == "std_msgs/String"


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
    types.message("std_msgs/String")
    large = "\n".join(f"int8 f{number}" for number in range(4000))
    for number in range(15):
        types.learn(header(f"own/Large{number}", large))
        types.message("std_msgs/String")  # in use
    assert types.message("own/Large14")
    assert types.message("std_msgs/String")
    with pytest.raises(DefinitionError):
        types.message("own/Large0")
    assert types.learn(header("own/Large0", large)) is types.message("own/Large0")[0]


def test_short_definitions_with_large_layouts_are_forgotten_in_order(types: KnownTypes) -> None:
    parts = [f"Part{level} a\nPart{level} b" for level in range(1, 12)] + ["int8 x"]
    text = "".join(f"\n{'=' * 80}\nMSG: own/Part{level}\n{part}" for level, part in enumerate(parts))
    for number in range(3):
        types.learn(header(f"own/Large{number}", f"Part0 a{text}"))
    assert len(text) < 2_000 and types.message("own/Large2")
    with pytest.raises(DefinitionError):
        types.message("own/Large0")


def test_the_operators_files_define_types_until_they_change(types: KnownTypes) -> None:
    types.learn(header("own/Heard", "int8 x"))
    with pytest.raises(DefinitionError, match="rosrv monitor reload"):
        types.service("own/Add")
    for field in ("a", "b"):
        types.define(Definitions.from_files({"own/Add.srv": f"int8 {field}\n---\nint8 sum\n"}))
        assert types.service("own/Add")[0].writer.fields == [field]
    assert types.message("own/Heard")[0].name == "own/Heard"
    types.define(Definitions.from_files({}))
    with pytest.raises(DefinitionError, match="does not know this service type"):
        types.service("own/Add")
    with pytest.raises(DefinitionError, match="does not know this message type"):
        types.message("own/AddRequest")


def test_a_message_is_encoded_once_for_all_clients_within_bounds(types: KnownTypes) -> None:
    given, learned = header("own/Bytes", "uint8[] x"), list[str]()

    def learn(fields: Mapping[str, str]) -> MessageCodec:
        learned.append(fields["type"])
        return types.learn(fields)

    def message(size: int) -> DoorMessage:
        return DoorMessage("/x", struct.pack("<I", size) + bytes(size), given, 0, learn, shared)

    def frame(message: DoorMessage, topic: str, compression: Compression) -> DoorFrame:
        return message.frame((topic, compression), publish_frame)

    shared = SharedFrames(most=150_000)
    first = message(10_000)
    for compression in ("none", "cbor", "png"):
        assert frame(first, "/x", compression) is frame(first, "/x", compression)
    assert len(learned) == 3
    assert frame(first, "x", "none") is not frame(first, "/x", "none")
    assert frame(first, "x", "none") is frame(first, "x", "none") and len(learned) == 4
    raw = message(50_000)
    assert frame(raw, "/x", "cbor-raw") is not frame(raw, "/x", "cbor-raw")  # it has the bytes of the message
    for size in (10_000, 10_000, 10_000, 50_000, 90_000):
        assert frame(message(size), "/x", "none")
        assert shared.bytes <= 150_000
    assert frame(first, "/x", "none") and len(learned) == 10  # it is no longer kept
