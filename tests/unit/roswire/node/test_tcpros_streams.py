"""The frames of a connection, cut anywhere."""

import asyncio
from random import Random

import pytest

from roswire.errors import LimitExceededError
from roswire.node.tcpros_streams import FrameReader
from roswire.tcpros import encode_frame

pytestmark = pytest.mark.anyio
LIMIT = 1 << 20


@pytest.mark.parametrize("seed", range(20))
async def test_frames_are_the_same_wherever_the_stream_is_cut(seed: int) -> None:
    """A frame does not wait for the rest of the next one."""
    random = Random(seed)  # noqa: S311  not a secret
    sizes = [random.choice((0, 1, 3, 200, 5000, 1 << 16, (1 << 16) + 1, 200_000)) for _ in range(60)]
    sent = [random.randbytes(size) for size in sizes]
    stream, ends = b"", []
    for frame in sent:
        stream += encode_frame(frame)
        ends.append(len(stream))
    reader, heard = asyncio.StreamReader(limit=1 << 19), list[bytes]()
    frames = FrameReader(reader, LIMIT)

    async def read() -> None:
        while True:
            heard.extend(await frames.next())

    reading = asyncio.ensure_future(read())
    fed = 0
    while fed < len(stream):
        piece = stream[fed : fed + random.choice((1, 3, 5, 100, 70_000, 300_000))]
        fed += len(piece)
        reader.feed_data(piece)
        await asyncio.sleep(1)
        assert len(heard) == sum(end <= fed for end in ends)
    assert heard == sent
    reader.feed_eof()
    with pytest.raises(ConnectionResetError, match="the peer ended the connection"):
        await reading


@pytest.mark.parametrize("before", [[], [b"x"], [bytes(100_000)]])
async def test_a_lying_length_is_refused_before_anything_is_kept(before: list[bytes]) -> None:
    reader = asyncio.StreamReader(limit=1 << 19)
    reader.feed_data(b"".join(map(encode_frame, before)) + (LIMIT + 1).to_bytes(4, "little"))
    frames = FrameReader(reader, LIMIT)
    with pytest.raises(LimitExceededError, match=f"frame of {LIMIT + 1} bytes"):
        while True:
            await frames.next()


@pytest.mark.parametrize("begun", [b"", b"\x05", b"\x05\0\0\0", b"\x05\0\0\0abc"])
async def test_a_connection_that_ends_inside_a_frame_is_an_error(begun: bytes) -> None:
    reader = asyncio.StreamReader()
    reader.feed_data(encode_frame(b"whole") + begun)
    reader.feed_eof()
    frames = FrameReader(reader, LIMIT)
    assert await frames.next() == [b"whole"]
    with pytest.raises(ConnectionResetError):
        await frames.next()
