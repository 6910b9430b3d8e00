import pytest

from appliance.features.recorder.excluded_topics import NAMED, known_sums, left_out_because
from appliance.features.recorder.settings import RecorderRules
from roswire.definitions import Definitions
from roswire.standard import standard_definitions

IMAGE = "sensor_msgs/Image"
STRING_SUM = standard_definitions().md5sum("std_msgs/String")
FILES = {
    "audio_common_msgs/AudioData.msg": "uint8[] data\n",
    "audio_common_msgs/AudioDataStamped.msg": "Header header\naudio_common_msgs/AudioData audio\n",
    "theora_image_transport/Packet.msg": (
        "Header header\nuint8[] data\nint32 b_o_s\nint32 e_o_s\nint64 granulepos\nint64 packetno\n"
    ),
}


def test_the_sums_of_excluded_types_are_those_of_their_definitions() -> None:
    definitions = standard_definitions().merge(Definitions.from_files(FILES))
    never = RecorderRules().never
    assert known_sums(never) == {name: definitions.md5sum(name) for name in never}
    assert known_sums(["sensor_msgs/Imag?", "/camera/*"]) == {IMAGE: definitions.md5sum(IMAGE)}
    assert known_sums(["/camera/*", "my_msgs/Face"]) == {}


@pytest.mark.parametrize(
    ("topic", "type_name", "md5sum", "why"),
    [
        ("/camera/left", "std_msgs/String", STRING_SUM, NAMED),
        ("/front", IMAGE, known_sums([IMAGE])[IMAGE], f"its publisher declares the type {IMAGE}"),
        ("/front", IMAGE, STRING_SUM, ""),
        ("/front", IMAGE, "*", ""),
        ("/front", "my_msgs/Face", STRING_SUM, "whose definition is unknown here"),
        ("/front", "std_msgs/String", STRING_SUM, ""),
    ],
)
def test_a_publishers_type_is_compared_with_the_definition(
    topic: str, type_name: str, md5sum: str, why: str
) -> None:
    never = ["/camera/*", IMAGE, "my_msgs/Face"]
    found = left_out_because(never, known_sums(never), topic, {"type": type_name, "md5sum": md5sum})
    assert found.endswith(why) if why else found == ""
