"""Convert CBOR frames of clients to JSON, within bounds.

cbor2 accepts tags that a door does not need, and a short frame can claim millions of values. So all heads are scanned
first: only the kinds of JSON, byte strings and the typed arrays of RFC 8746 are accepted.
"""

import struct

import cbor2
import msgspec

from appliance.features.doors.message_reader import MessageValueError

MAX_NESTING = 70
"""The deepest nesting; messages nest at most 64 levels deep."""

MAX_ITEMS = 50_000
"""The most values of one frame; a typed array is one value."""

MAX_NUMBERS = 500_000
"""The most numbers in the typed arrays of one frame. Arrays of `uint8` do not count, because they become base64."""

_CODES = {
    64: "B", 65: ">H", 66: ">I", 67: ">Q", 68: "B", 69: "<H", 70: "<I", 71: "<Q", 72: "b", 73: ">h", 74: ">i",
    75: ">q", 77: "<h", 78: "<i", 79: "<q", 81: ">f", 82: ">d", 85: "<f", 86: "<d",
}  # fmt: skip
_BYTE_TAGS = frozenset({64, 68})
_INTEGERS, _NEGATIVES, _BYTES, _TEXT, _ARRAY, _MAP, _TAG, _OTHER = range(8)
_OTHERS = frozenset({20, 21, 22, 25, 26, 27})  # false, true, null, floats of 16, 32 and 64 bits


def json_of_cbor(frame: bytes) -> bytes:
    """Return a CBOR frame as JSON, or raise `MessageValueError`.

    Byte strings and arrays of `uint8` become base64. NaN becomes null, which no field accepts.
    """
    try:
        _scan(frame)
        return msgspec.json.encode(cbor2.loads(frame, tag_hook=_typed_array))
    except (ValueError, cbor2.CBORError) as error:
        raise MessageValueError(f"not CBOR: {error}") from None


def _scan(frame: bytes) -> None:
    position = items = numbers = 0
    left, is_map = [1], [False]  # of each open array or object: the values that it still has
    while left:
        if not left[-1]:
            left.pop()
            is_map.pop()
            continue
        is_key = is_map[-1] and left[-1] % 2 == 0
        left[-1] -= 1
        items += 1
        start = position
        major, argument, position = _head(frame, position)
        if is_key and major != _TEXT:
            raise MessageValueError(f"a key that is not a text at byte {start}")
        if major in (_BYTES, _TEXT):
            position += argument
        elif major in (_ARRAY, _MAP):
            left.append(argument * (2 if major == _MAP else 1))
            is_map.append(major == _MAP)
        elif major == _TAG:
            position, count = _scan_typed_array(frame, position, argument)
            numbers += count
        if numbers > MAX_NUMBERS:
            raise MessageValueError(
                f"a frame of more than {MAX_NUMBERS} numbers in typed arrays: send smaller messages"
            )
        if position + left[-1] > len(frame):
            raise MessageValueError(f"not CBOR: the frame ends inside the value at byte {start}")
        if len(left) > MAX_NESTING:
            raise MessageValueError(f"a frame nested deeper than {MAX_NESTING} levels: nest it less")
        if items > MAX_ITEMS:
            raise MessageValueError(
                f"a frame of more than {MAX_ITEMS} values; send numbers as a typed array (RFC 8746)"
            )
    if position != len(frame):
        raise MessageValueError(f"{len(frame) - position} bytes after the end of the CBOR value")


def _head(frame: bytes, position: int) -> tuple[int, int, int]:
    if position >= len(frame):
        raise MessageValueError(f"not CBOR: the frame ends at byte {position}")
    major, short = frame[position] >> 5, frame[position] & 31
    if short == 31:
        raise MessageValueError(f"a value of indefinite length at byte {position}; give the length")
    if 27 < short < 31 or (major == _OTHER and short not in _OTHERS):
        raise MessageValueError(f"an unknown kind of value at byte {position}")
    position += 1
    if short < 24:
        return major, short, position
    size = 1 << (short - 24)
    return major, int.from_bytes(frame[position : position + size], "big"), position + size


def _scan_typed_array(frame: bytes, position: int, tag: int) -> tuple[int, int]:
    if tag not in _CODES:
        raise MessageValueError(f"the CBOR tag {tag}; only typed arrays (RFC 8746) may have tags")
    major, size, position = _head(frame, position)
    if major != _BYTES:
        raise MessageValueError(f"the CBOR tag {tag} of a value that is not a byte string")
    element = struct.calcsize(_CODES[tag])
    if size % element:
        raise MessageValueError(
            f"a typed array of {size} bytes, which is not a multiple of its elements' {element} bytes"
        )
    return position + size, 0 if tag in _BYTE_TAGS else size // element


def _typed_array(tag: cbor2.CBORTag, _immutable: bool) -> object:
    data: bytes = tag.value
    if tag.tag in _BYTE_TAGS:
        return data
    code = _CODES[tag.tag]
    order = code[0] if code[0] in "<>" else "="
    return [*struct.unpack(f"{order}{len(data) // struct.calcsize(code)}{code[-1]}", data)]
