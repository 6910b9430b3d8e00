"""Convert a bag to MCAP (profile `ros1`), for tools that cannot read bags."""

from collections import Counter
from collections.abc import Iterator, Mapping
from contextlib import ExitStack
from io import BytesIO
from pathlib import Path

from mcap.writer import CompressionType, Writer

from appliance.features.recorder.bag_reader import BagReader
from appliance.features.recorder.ring import CARRIED

_LONGEST = 1 << 32
_OF_SENDER = ("md5sum", "callerid", "host", "latching", CARRIED)


def as_mcap(bag: Path) -> Iterator[bytes]:
    """Yield the file in pieces; the bag may be removed in the meantime.

    Raise `OSError`, or `ValueError` for an invalid bag.
    """
    opened = ExitStack()
    return _pieces(opened, opened.enter_context(BagReader.of(bag)))


class _Pieces(BytesIO):
    """The bytes since the last `take`; `tell` counts all bytes of the file."""

    _taken = 0

    def tell(self) -> int:
        return self._taken + super().tell()

    def take(self) -> bytes:
        piece = self.getvalue()
        self._taken += len(piece)
        self.seek(0)
        self.truncate()
        return piece


def _pieces(opened: ExitStack, reader: BagReader) -> Iterator[bytes]:
    with opened:
        output = _Pieces()
        writer = Writer(output, compression=CompressionType.NONE, enable_crcs=False)
        writer.start("ros1", "rosrv")
        schemas: dict[tuple[str, str], int] = {}
        channels: dict[int, int] = {}
        counts: Counter[int] = Counter()
        for place, connection in reader.messages(reader.connections.keys()):
            if connection not in channels:
                channels[connection] = _channel(writer, reader.connections[connection], schemas)
            time, data = place.time, reader.body(place, _LONGEST)[1]
            writer.add_message(channels[connection], time, data, time, counts[connection] & 0xFFFFFFFF)
            counts[connection] += 1
            if piece := output.take():
                yield piece
        writer.finish()  # type: ignore[no-untyped-call]  # the library does not annotate it
        yield output.take()


def _channel(writer: Writer, header: Mapping[str, str], schemas: dict[tuple[str, str], int]) -> int:
    name, text = header["type"], header["message_definition"]
    if (name, text) not in schemas:
        schemas[name, text] = writer.register_schema(_text(name), "ros1msg", _text(text).encode())
    sender = {"latching": "0"} | {key: _text(header[key]) for key in _OF_SENDER if key in header}
    return writer.register_channel(_text(header["topic"]), "ros1", schemas[name, text], sender)


def _text(text: str) -> str:
    return text.encode("utf-8", "replace").decode()
