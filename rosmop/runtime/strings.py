"""Operations on strings, which are immutable bytes: changing one character makes a new string."""

import math
import re

from rosmop.runtime.action_context import BYTES_PER_INSTRUCTION, PART, Context, FaultError
from rosmop.runtime.numbers import f32
from roswire.counted import counted

NOT_FOUND = (1 << 64) - 1
"""`std::string::npos`."""

_LONG = 64  # bytes; shorter strings are not charged
_ALL = bytes(range(256))
_INTEGERS = {
    2: re.compile(rb"\s*+([+-]?[01]++)"),
    8: re.compile(rb"\s*+([+-]?[0-7]++)"),
    10: re.compile(rb"\s*+([+-]?[0-9]++)"),
    16: re.compile(rb"\s*+([+-]?)(?:0[xX](?=[0-9a-fA-F]))?([0-9a-fA-F]++)"),
}
_FLOATING = re.compile(
    rb"\s*+([+-]?(?:(?:[0-9]++\.?[0-9]*+|\.[0-9]++)(?:[eE][+-]?[0-9]++)?|inf(?:inity)?|nan))", re.IGNORECASE
)


def join(context: Context, left: bytes, right: bytes, site: int) -> bytes:
    size = len(left) + len(right)
    if size > _LONG:
        context.allocate(size, site)
    return left + right


def extend(context: Context, text: bytes, added: bytes, site: int) -> bytes:
    size = len(text) + len(added)
    if size > _LONG:
        context.allocate(size, site, len(text))
    return text + added


def repeat(context: Context, count: int, character: int, site: int) -> bytes:
    context.allocate(count, site)
    return bytes((character & 0xFF,)) * count


def character(text: bytes, index: int, site: int) -> int:
    """`text[index]`, a signed char; the character after the last is 0."""
    if 0 <= index < len(text):
        value = text[index]
        return value - 256 if value > 127 else value
    if index == len(text):
        return 0
    raise FaultError(site, f"index {index} is past the end of {_string(text)}")


def member(text: bytes, index: int, site: int) -> int:
    """`text.at(index)`, `front` or `back`: unlike in `character`, the index after the last is a fault."""
    if index == len(text):
        raise FaultError(site, f"index {index} is past the end of {_string(text)}")
    return character(text, index, site)


def with_character(context: Context, text: bytes, index: int, value: int, site: int) -> bytes:
    if not 0 <= index < len(text):
        raise FaultError(site, f"index {index} is past the end of {_string(text)}")
    if len(text) > _LONG:
        context.allocate(len(text), site, len(text))
    return text[:index] + bytes((value & 0xFF,)) + text[index + 1 :]


def substring(context: Context, text: bytes, start: int, count: int, site: int) -> bytes:
    if start > len(text):
        raise FaultError(site, f"substr from {start}, past the end of {_string(text)}")
    result = text[start : start + count]
    if len(result) > _LONG:
        context.allocate(len(result), site)
    return result


def find(context: Context, text: bytes, wanted: bytes, start: int, site: int) -> int:
    context.spend((len(text) + len(wanted)) // 16, site)
    found = _find(text, wanted, start) if start <= len(text) else -1
    return NOT_FOUND if found < 0 else found


def find_last(context: Context, text: bytes, wanted: bytes, start: int, site: int) -> int:
    context.spend((len(text) + len(wanted)) // 16, site)
    head = text[: min(start, len(text)) + len(wanted)]
    if len(wanted) <= _LONG:
        found = head.rfind(wanted)
    else:
        found = _find(head[::-1], wanted[::-1], 0)
        found = len(head) - found - len(wanted) if found >= 0 else -1
    return NOT_FOUND if found < 0 else found


def _find(text: bytes, wanted: bytes, start: int) -> int:
    """Return `text.find(wanted, start)`.

    The times of `find` and `rfind` can grow with the product of the lengths, but not that of `find` in a text that is
    long, and much longer than `wanted`: zeros after the text make it so.
    """
    if len(wanted) <= _LONG:
        return text.find(wanted, start)
    found = (text + bytes(30_000 + 4 * len(wanted))).find(wanted, start)
    return found if found + len(wanted) <= len(text) else -1


def find_any(context: Context, text: bytes, wanted: bytes, start: int, site: int) -> int:
    context.spend(len(text) + len(wanted) // 16, site)
    if len(wanted) > _LONG:
        wanted = _ALL.translate(None, _ALL.translate(None, wanted))  # each character once
    for first in range(start, len(text), PART):
        context.turn.check()
        for index in range(first, min(first + PART, len(text))):
            if text[index] in wanted:
                return index
    return NOT_FOUND


def charge(context: Context, text: bytes, site: int) -> bytes:
    if len(text) > _LONG:
        context.spend(len(text) // BYTES_PER_INSTRUCTION, site)
    return text


def compare(left: bytes, right: bytes) -> int:
    return (left > right) - (left < right)


def resize(context: Context, text: bytes, size: int, value: int, site: int) -> bytes:
    context.allocate(size, site, len(text))
    return text[:size].ljust(size, bytes((value & 0xFF,)))


def erase(context: Context, text: bytes, start: int, count: int, site: int) -> bytes:
    if start > len(text):
        raise FaultError(site, f"erase from {start}, past the end of {_string(text)}")
    context.allocate(len(text), site, len(text))
    return text[:start] + text[start + count :]


def insert(context: Context, text: bytes, start: int, added: bytes, site: int) -> bytes:
    if start > len(text):
        raise FaultError(site, f"insert at {start}, past the end of {_string(text)}")
    context.allocate(len(text) + len(added), site, len(text))
    return text[:start] + added + text[start:]


def replace(context: Context, text: bytes, start: int, count: int, added: bytes, site: int) -> bytes:  # noqa: PLR0917  the arguments are C++'s
    if start > len(text):
        raise FaultError(site, f"replace at {start}, past the end of {_string(text)}")
    context.allocate(len(text) + len(added), site, len(text))
    return text[:start] + added + text[start + count :]


def shorten(context: Context, text: bytes, site: int) -> bytes:
    if not text:
        raise FaultError(site, "pop_back of an empty string")
    return charge(context, text, site)[:-1]


def fill(context: Context, buffer: bytes, text: bytes, site: int) -> bytes:
    """A `char` buffer after `strcpy(buffer, text)`."""
    _allocate(context, buffer, site)
    copied = _cut(text) + b"\0"
    if len(copied) > len(buffer):
        raise FaultError(
            site, f"strcpy of {counted(len(copied), 'character')} into a buffer of {len(buffer)}"
        )
    return copied + buffer[len(copied) :]


def filled_at_most(context: Context, buffer: bytes, text: bytes, count: int, site: int) -> bytes:
    """A `char` buffer after `strncpy(buffer, text, count)`."""
    _allocate(context, buffer, site)
    if count > len(buffer):
        raise FaultError(site, f"strncpy of {counted(count, 'character')} into a buffer of {len(buffer)}")
    copied = _cut(text)[:count]
    return copied + b"\0" * (count - len(copied)) + buffer[count:]


def print_into(context: Context, buffer: bytes, text: bytes, limit: int, site: int) -> bytes:
    return fill(context, buffer, text[: limit - 1], site) if limit else buffer


def extend_buffer(context: Context, buffer: bytes, text: bytes, site: int) -> bytes:
    """A `char` buffer after `strcat(buffer, text)`."""
    _allocate(context, buffer, site)
    return fill(context, buffer, _cut(buffer) + _cut(text), site)


def with_zero(context: Context, text: bytes, site: int) -> bytes:
    return charge(context, text, site) + b"\0"


def until_zero(context: Context, buffer: bytes, site: int) -> bytes:
    return _cut(charge(context, buffer, site))


def _string(text: bytes) -> str:
    return f"a string of {counted(len(text), 'character')}"


def _cut(buffer: bytes) -> bytes:
    end = buffer.find(0)
    return buffer if end < 0 else buffer[:end]


def _allocate(context: Context, buffer: bytes, site: int) -> None:
    if len(buffer) > _LONG:
        context.allocate(len(buffer), site, len(buffer))


def parse_integer(text: bytes, base: int, least: int, most: int, site: int) -> int:
    """`std::stoi` and similar functions, which fault where C++ throws."""
    found = _INTEGERS[base].match(text[:1000])
    if found is None:
        raise FaultError(site, "the string does not begin with a number")
    value = int(b"".join(found.groups()), base)
    if not least and -most <= value < 0:
        return value + most + 1  # C++ wraps a negative number if the result is unsigned
    if not least <= value <= most:
        raise FaultError(site, f"the number does not fit; it must be from {least} to {most}")
    return value


def parse_floating(text: bytes, bits: int, site: int) -> float:
    """`std::stod` or `std::stof`, which fault where C++ throws."""
    match = _FLOATING.match(text[:1000])
    if match is None:
        raise FaultError(site, "the string does not begin with a number")
    value = float(match[1]) if bits == 64 else f32(float(match[1]))
    digits = re.split(rb"[eE]", match[1])[0]
    if digits[-1:] in b"0123456789." and (math.isinf(value) or (not value and digits.strip(b"+-0."))):
        raise FaultError(site, f"the number does not fit into {'a double' if bits == 64 else 'a float'}")
    return value


def lenient_integer(text: bytes) -> int:
    """`atoi(text)`: 0 for text that is not a number."""
    match = re.match(rb"\s*+[+-]?[0-9]{1,18}+", text[:1000])
    return int(match[0]) if match else 0


def lenient_floating(text: bytes) -> float:
    """`atof(text)`: 0 for text that is not a number."""
    match = _FLOATING.match(text[:1000])
    return float(match[1]) if match else 0.0
