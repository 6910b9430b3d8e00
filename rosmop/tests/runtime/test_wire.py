from random import Random

import pytest

from rosmop.runtime.wire import WireMessage


def test_a_message_written_back_is_unchanged() -> None:
    message = WireMessage(bytearray(b"abcdef"), 0)
    found = [message.changed]
    message.patch(1, b"xy")
    found.append(message.changed)
    message.patch(2, b"c")
    message.patch(1, b"b")
    found.append(message.changed)
    assert found == [False, True, False]
    assert bytes(message.buffer) == b"abcdef"


def test_writing_equal_bytes_touches_nothing() -> None:
    message = WireMessage(bytearray(b"abcdef"), 0)
    found = []
    for start, end, new in ((1, 3, b"bc"), (1, 3, b"bx"), (0, 2, b"abc"), (0, 3, b"abc"), (0, 1, b"z")):
        message.touched = 0
        message.splice([(start, end, new, 1)])
        found.append(message.touched)
    assert found == [False, True, True, False, True]


def test_a_received_buffer_that_cannot_be_written_is_left_alone() -> None:
    received = b"abcdef"
    for buffer in (received, memoryview(received)):
        message = WireMessage(buffer, 0)
        message.patch(0, b"z")
        assert bytes(message.buffer) == b"zbcdef"
    assert received == b"abcdef"


def test_only_what_is_overwritten_is_kept_of_a_large_message() -> None:
    message = WireMessage(memoryview(bytearray(1 << 20)), 0)
    message.patch(8, b"\x01")
    message.patch(100, b"\x01\x02")
    assert message.changed
    assert message.written == [(8, b"\0"), (100, b"\0\0")]


@pytest.mark.parametrize("seed", range(200))
def test_patches_and_splices_agree_with_a_copy(seed: int) -> None:
    random = Random(seed)  # noqa: S311  draws examples, not keys
    received = bytes(random.choices(b"ab", k=12))
    message, copy = WireMessage(bytearray(received), 0), bytearray(received)
    for _ in range(random.randint(1, 5)):
        start = random.randrange(len(copy))
        end = min(len(copy), start + random.randint(1, 3))
        if random.random() < 0.7:
            new = bytes(random.choices(b"ab", k=end - start))
            message.patch(start, new)
        else:
            new = bytes(random.choices(b"ab", k=random.randint(0, 4)))
            message.splice([(start, end, new, 1)])
        copy[start:end] = new
        if not copy:
            break
    assert bytes(message.buffer) == bytes(copy)
    assert message.changed == (bytes(copy) != received)
