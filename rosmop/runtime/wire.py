"""Decode and encode the parts of messages.

Positions count from the start of `buffer`. Reading past the end raises `MalformedError` or `struct.error`.
"""

import struct
from collections.abc import Callable, Sequence
from typing import Any, TypeVar

from rosmop.form.nodes import SafeMessage
from rosmop.runtime.action_context import PART, Context, MalformedError
from rosmop.runtime.safe_messages import HEAD, to_bytes
from rosmop.runtime.times import with_part
from rosmop.types.value_types import Value
from roswire.counted import counted

_T = TypeVar("_T")
Buffer = bytes | bytearray | memoryview

_LENGTH = struct.Struct("<I")
MAX_EMPTY = 1_000_000

_MAX_DECODED = 1_000_000  # the maximum number of elements that are decoded one by one
FEW = 64  # this number of elements takes less time than one instruction


def text(buffer: Buffer, start: int) -> tuple[bytes, int]:
    first = start + 4
    end = first + _LENGTH.unpack_from(buffer, start)[0]
    if end > len(buffer):
        raise MalformedError(f"a string ends at byte {end} of a message of {len(buffer)}")
    return bytes(buffer[first:end]), end


def text_end(buffer: Buffer, start: int) -> int:
    return int(start + 4 + _LENGTH.unpack_from(buffer, start)[0])


def texts_end(buffer: Buffer, start: int, number: int) -> int:
    for _ in range(number):
        start += 4 + _LENGTH.unpack_from(buffer, start)[0]
    return start


def require_end(buffer: Buffer, end: int) -> None:
    if end != len(buffer):
        raise MalformedError(f"it has {len(buffer)} bytes, and its last field ends at byte {end}")


def count(buffer: Buffer, start: int, least: int) -> int:
    number: int = _LENGTH.unpack_from(buffer, start)[0]
    if number * least > len(buffer) - start - 4 or (not least and number > MAX_EMPTY):
        raise MalformedError(f"an array of {counted(number, 'element')} in a message of {len(buffer)} bytes")
    return number


def numbers(buffer: Buffer, start: int, number: int, code: str, size: int) -> tuple[list[Any], int]:
    end = start + number * size
    if end > len(buffer):
        raise MalformedError(f"an array ends at byte {end} of a message of {len(buffer)}")
    if code == "B":
        return list(bytes(buffer[start:end])), end
    return list(struct.unpack_from(f"<{number}{code}", buffer, start)), end


def moments(buffer: Buffer, start: int, number: int, code: str) -> tuple[list[int], int]:
    """Return times (code `I`) or durations (`i`) in nanoseconds, and the position after them."""
    pairs, end = numbers(buffer, start, 2 * number, code, 4)
    return [pairs[i] * 1_000_000_000 + pairs[i + 1] for i in range(0, len(pairs), 2)], end


def _require_few(number: int) -> None:
    if number > _MAX_DECODED:
        raise MalformedError(
            f"an array of {counted(number, 'element')}; at most {_MAX_DECODED} that are not numbers are read"
        )


def elements(
    buffer: Buffer,
    start: int,
    number: int,
    decode: Callable[[Buffer, int], tuple[_T, int]],
    check: Callable[[int], None],
) -> tuple[list[_T], int]:
    _require_few(number)
    values = []
    for index in range(number):
        if not index % PART:
            check(PART)
        value, start = decode(buffer, start)
        values.append(value)
    return values, start


def rows(
    buffer: Buffer, start: int, number: int, width: int, check: Callable[[int], None]
) -> tuple[list[list[bytes]], int]:
    """Like `elements`, of records of `width` strings: a diagnostic array has thousands of them."""
    _require_few(number)
    found = []
    for index in range(number):
        if not index % PART:
            check(PART)
        row = []
        for _ in range(width):
            first = start + 4
            start = first + _LENGTH.unpack_from(buffer, start)[0]
            row.append(bytes(buffer[first:start]))
        if start > len(buffer):
            raise MalformedError(f"a string ends at byte {start} of a message of {len(buffer)}")
        found.append(row)
    return found, start


def skip(buffer: Buffer, start: int, number: int, end: Callable[[Buffer, int], int], context: Context) -> int:
    if number > FEW:
        context.walk(number)
    return _skip(buffer, start, number, end, context)


def skip_inner(
    buffer: Buffer, start: int, number: int, end: Callable[[Buffer, int], int], context: Context
) -> int:
    """Like `skip` within a skipped element: there may be many such calls, so even a few elements are charged."""
    context.walk(number + 1)
    return _skip(buffer, start, number, end, context)


def _skip(
    buffer: Buffer, start: int, number: int, end: Callable[[Buffer, int], int], context: Context
) -> int:
    for first in range(0, number, PART):
        if first:
            context.turn.check()
        for _ in range(min(PART, number - first)):
            start = end(buffer, start)
    return start


def put_text(value: bytes, out: bytearray) -> None:
    out += len(value).to_bytes(4, "little")
    out += value


def put_numbers(values: list[float], code: str, out: bytearray) -> None:
    out += struct.pack(f"<{len(values)}{code}", *values)


def put_moments(values: list[int], code: str, out: bytearray) -> None:
    out += struct.pack(
        f"<{2 * len(values)}{code}", *(part for v in values for part in divmod(v, 1_000_000_000))
    )


class WireMessage:
    """The message of an event, with all changes so far.

    Numbers are written in place, and only the replaced bytes are kept, so a large image is not copied when
    its stamp changes. `touched` has a bit for each statement (by the sites in `marks`) that changed bytes
    since the last event. `cause` is the site that dropped the message, and `stopped` the site that replaced
    it with the safe message of its `channel`. It is `altered` for an event if an earlier one changed bytes, or if it is
    not the message of a sender.
    """

    __slots__ = (
        "_replaced",
        "altered",
        "buffer",
        "cause",
        "channel",
        "dropped",
        "marks",
        "past",
        "stopped",
        "time",
        "touched",
        "written",
    )  # fmt: skip

    def __init__(
        self, buffer: Buffer, time: int, channel: str | None = None, *, altered: bool = False
    ) -> None:
        self.altered = altered
        self.buffer = buffer
        self.time = time
        self.written: list[tuple[int, bytes]] | None = None  # positions and old bytes of changes, in order
        self._replaced: bytes | None = None  # the received bytes, once another buffer is used
        self.dropped = False
        self.cause: int | None = None
        self.channel = channel
        self.stopped: int | None = None
        self.touched = 0
        self.marks: Sequence[int] = ()
        self.past: tuple[int, int, int] | None = None  # an index was past the end: site, index, elements

    @property
    def changed(self) -> bool:
        if self._replaced is not None:
            return bytes(self.buffer) != self._replaced
        if self.written is None:
            return False
        ends = -1
        for start, old in sorted(self.written):
            if start < ends:  # bytes written twice may again equal the received bytes
                return bytes(self.buffer) != self._original()
            ends = start + len(old)
        return True  # `patch` compares old and new bytes

    def event_ended(self) -> None:
        self.altered = self.altered or self.written is not None or self._replaced is not None

    @property
    def overwritten(self) -> Sequence[tuple[int, bytes]]:
        return self.written or ()

    def patch(self, start: int, new: bytes, by: int = 1) -> None:
        """Replace bytes with the same number of new bytes, and set the bits `by` of `touched` if they differ."""
        end = start + len(new)
        old = self.buffer[start:end]
        if old == new:
            return
        self.touched |= by
        if self._replaced is None:
            if self.written is None:
                self.written = []
                if isinstance(self.buffer, bytes) or (
                    isinstance(self.buffer, memoryview) and self.buffer.readonly
                ):
                    self.buffer = bytearray(self.buffer)
            self.written.append((start, bytes(old)))
        self.buffer[start:end] = new  # type: ignore[index]  # it is a bytearray or a writable memoryview

    def splice(self, edits: list[tuple[int, int, bytes, int]]) -> None:
        """Apply edits, each with start, end, new bytes and bits (see `patch`). The length may change."""
        if all(len(new) == end - start for start, end, new, _ in edits):
            for start, _, new, by in edits:
                self.patch(start, new, by)
            return
        if self._replaced is None:
            self._replaced = self._original()
        pieces = []
        last = 0
        for start, end, new, by in sorted(edits):
            self.touched |= by if self.buffer[start:end] != new else 0
            pieces += [bytes(self.buffer[last:start]), new]
            last = end
        pieces.append(bytes(self.buffer[last:]))
        self.buffer = bytearray(b"".join(pieces))

    def stop(self, safe: SafeMessage, site: int) -> None:
        """Replace the message with a safe message; a header keeps its `seq` and `stamp`."""
        first = HEAD if safe.stamped and len(self.buffer) >= HEAD else 0
        new = safe.data[first:] if first else to_bytes(safe, self.time)
        self.splice([(first, len(self.buffer), new, 0)])
        self.stopped = site

    def _original(self) -> bytes:
        if not self.written:
            return bytes(self.buffer)
        original = bytearray(self.buffer)
        for start, old in reversed(self.written):
            original[start : start + len(old)] = old
        return bytes(original)


def whole(
    message: WireMessage,
    context: Context,
    decode: Callable[[Buffer, int], tuple[Any, int]],
    pending: tuple[tuple[bool, tuple[int | str, ...], Value], ...],
    site: int,
) -> list[Any]:
    """Return the decoded message, with the fields that the action assigned: `pending` has (assigned, path, value)."""
    context.allocate(len(message.buffer), site)
    value: list[Any] = decode(message.buffer, 0)[0]
    for assigned, path, new in pending:
        if assigned:
            _set(value, path, new, site)
    return value


def _set(value: list[Any], path: tuple[int | str, ...], new: Any, site: int) -> None:
    *above, last = path
    for index in above[:-1] if isinstance(last, str) else above:
        value = value[index]  # type: ignore[index]  # only the last item is a part of a time
    if isinstance(last, str):
        place = above[-1]
        value[place] = with_part(value[place], last.encode(), new, site)  # type: ignore[index]  # as above
    else:
        value[last] = new
