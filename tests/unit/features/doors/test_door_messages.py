import struct
import tracemalloc

from appliance.features.doors.door_messages import DoorMessage, RecentEncodings
from appliance.features.doors.known_types import KnownTypes
from appliance.features.doors.values import ValueLimits
from appliance.features.doors.viewer_queue import ViewerQueue
from roswire.standard import standard_definitions

_POSES = 1000
_TYPE = "geometry_msgs/PoseArray"
BODY = struct.pack("<5I", 0, 0, 0, 0, _POSES) + bytes(56 * _POSES)


def encodings() -> tuple[RecentEncodings, dict[str, str]]:
    types = KnownTypes(standard_definitions(), ValueLimits())
    _codec, known = types.message(_TYPE)
    fields = {"type": _TYPE, "md5sum": known.md5sum(_TYPE), "message_definition": known.full_text(_TYPE)}
    return RecentEncodings(types.learn, 1 << 20), fields


def test_clients_share_an_encoding_that_is_made_once() -> None:
    recent, header = encodings()
    message = DoorMessage("/poses", BODY, header, 1, recent)
    assert recent.json(message) is recent.json(message)
    assert recent.cbor(message) is message.cbor


def test_messages_that_wait_for_a_slow_client_keep_no_encodings() -> None:
    recent, header = encodings()
    slow = ViewerQueue[str]()
    slow.configure("/poses", depth=1000, interval=0.0)
    tracemalloc.start()
    for _number in range(50):
        message = DoorMessage("/poses", bytes(bytearray(BODY)), header, 1, recent)
        slow.put("/poses", message, len(message.body), 0.0)
        assert message.json and message.cbor
    taken, _peak = tracemalloc.get_traced_memory()
    tracemalloc.stop()
    assert slow.dropped == 0
    assert taken < slow.memory.held + (2 << 20)
