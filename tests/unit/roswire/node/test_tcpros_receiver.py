import asyncio
from itertools import pairwise
from random import Random

import pytest

from roswire.errors import LimitExceededError
from roswire.node.tcpros_receiver import TcprosReceiver
from roswire.node.topics import OwnMemory
from roswire.tcpros import Body, encode_frame

pytestmark = pytest.mark.anyio
LIMIT = 1 << 20


class Connection(asyncio.Transport):
    """Feeds a receiver as an event loop does. Bytes wait while the receiver does not read."""

    def __init__(self, memory: int = 10 * LIMIT) -> None:
        super().__init__()
        self.memory, self.skipped = OwnMemory(memory), 0
        self.receiver = TcprosReceiver(self.memory, self._skip)
        self.heard: list[Body] = []
        self._waiting, self._reads = bytearray(), True
        self.closed = False
        self.receiver.connection_made(self)

    def _skip(self) -> None:
        self.skipped += 1

    def feed(self, data: bytes) -> None:
        self._waiting += data
        while self._waiting and self._reads:
            buffer = self.receiver.get_buffer(-1)
            count = min(len(buffer), len(self._waiting))
            buffer[:count] = self._waiting[:count]
            buffer.release()
            del self._waiting[:count]
            self.receiver.buffer_updated(count)

    def pause_reading(self) -> None:
        self._reads = False

    def resume_reading(self) -> None:
        self._reads = True
        asyncio.get_running_loop().call_soon(self.feed, b"")

    def close(self) -> None:
        self.closed = True
        self._reads = False

    def listen(self) -> asyncio.Task[None]:
        return asyncio.ensure_future(self.receiver.deliver_to(self.heard.append, LIMIT))


@pytest.mark.parametrize("seed", range(20))
async def test_frames_are_the_same_wherever_the_stream_is_cut(seed: int) -> None:
    random = Random(seed)  # noqa: S311  not a secret
    sizes = [random.choice((0, 1, 3, 200, 5000, 65_531, 65_532, 65_533, 1 << 16, 200_000)) for _ in range(60)]
    sent = [random.randbytes(size) for size in sizes]
    stream, ends = b"", []
    for frame in sent:
        stream += encode_frame(frame)
        ends.append(len(stream))
    connection = Connection(memory=100_000)
    listening = connection.listen()
    await asyncio.sleep(0)
    fed = 0
    while fed < len(stream):
        piece = stream[fed : fed + random.choice((1, 3, 5, 100, 70_000, 300_000))]
        fed += len(piece)
        connection.feed(piece)
        await asyncio.sleep(1)
        whole = [frame for frame, end in zip(sent, ends, strict=True) if end <= fed and len(frame) <= 100_000]
        assert connection.heard == whole
        assert connection.memory.held <= 100_000
    assert connection.skipped == sizes.count(200_000)
    connection.receiver.connection_lost(None)
    with pytest.raises(ConnectionResetError, match="the peer ended the connection"):
        await listening
    assert connection.memory.held == 0


async def test_frames_after_the_wanted_one_wait() -> None:
    connection = Connection()
    connection.feed(b"".join(map(encode_frame, (b"header", bytes(100_000), b"a", b"b"))))
    for expected in (b"header", bytes(100_000), b"a"):
        assert await connection.receiver.next(LIMIT) == expected
    listening = connection.listen()
    await asyncio.sleep(1)
    assert connection.heard == [b"b"]
    listening.cancel()


async def test_other_tasks_have_a_turn_between_many_frames() -> None:
    connection = Connection()
    listening = connection.listen()
    await asyncio.sleep(0)
    connection.feed(encode_frame(b"x") * 1000 + encode_frame(bytes(100_000)) * 2)
    counts = [0]
    while len(connection.heard) < 1002:
        counts.append(len(connection.heard))
        await asyncio.sleep(0)
    assert max(after - before for before, after in pairwise(counts)) <= 64
    listening.cancel()


async def test_no_frame_is_delivered_again_after_an_error_of_its_receiver() -> None:
    connection = Connection()

    def take(body: Body) -> None:
        connection.heard.append(body)
        if body == b"64":
            raise KeyError(body)

    listening = asyncio.ensure_future(connection.receiver.deliver_to(take, LIMIT))
    await asyncio.sleep(0)
    frames = [b"%d" % number for number in range(100)]
    connection.feed(b"".join(map(encode_frame, frames)))
    await asyncio.sleep(1)
    connection.feed(encode_frame(b"later"))
    with pytest.raises(KeyError):
        await listening
    assert (connection.heard, connection.closed) == (frames[:65], True)


@pytest.mark.parametrize("before", [[], [b"x"], [bytes(100_000)]])
async def test_a_lying_length_is_refused_before_anything_is_kept(before: list[bytes]) -> None:
    connection = Connection()
    listening = connection.listen()
    await asyncio.sleep(0)
    connection.feed(b"".join(map(encode_frame, before)) + (LIMIT + 1).to_bytes(4, "little"))
    await asyncio.sleep(1)
    with pytest.raises(LimitExceededError, match=f"frame of {LIMIT + 1} bytes"):
        await listening
    assert (connection.heard, connection.closed, connection.memory.held) == (before, True, 0)


@pytest.mark.parametrize(
    "begun", [b"", b"\x05", b"\x05\0\0\0", b"\x05\0\0\0abc", b"\xff\xff\1\0" + bytes(30_000)]
)
async def test_a_connection_that_ends_inside_a_frame_is_an_error(begun: bytes) -> None:
    connection = Connection()
    listening = connection.listen()
    await asyncio.sleep(0)
    connection.feed(encode_frame(b"whole") + begun)
    assert connection.heard == [b"whole"]
    connection.receiver.connection_lost(ConnectionResetError("broken"))
    with pytest.raises(ConnectionResetError):
        await listening
    assert connection.memory.held == 0
