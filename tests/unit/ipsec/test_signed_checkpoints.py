import hashlib
import resource
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import pytest

from appliance.base.clock import wall_ns
from appliance.ipsec.signed_checkpoints import CheckpointMemory, CheckpointRefusedError

_NONE = "0" * 64
_BLOCK = 4096


def checkpoint(number: int, previous: str = _NONE, log: str = "a" * 32, digest: str = "b" * 64) -> bytes:
    return (
        f"rosrv audit checkpoint 1\nlog {log}\nnumber {number}\nsequence {number * 10}\n"
        f"hash {digest}\ntime 1\nprevious {previous}\n"
    ).encode()


def digest(text: bytes) -> str:
    return hashlib.sha256(text).hexdigest()


def test_each_follows_the_one_before(tmp_path: Path) -> None:
    previous = _NONE
    for number in range(1, 10):
        text = checkpoint(number, previous)
        CheckpointMemory(tmp_path, wall_ns).accept(text)
        previous = digest(text)


def test_asked_again(tmp_path: Path) -> None:
    first = checkpoint(1)
    second = checkpoint(2, digest(first))
    signed = CheckpointMemory(tmp_path, wall_ns)
    for text in (first, second, first, second):
        signed.accept(text)


@pytest.mark.parametrize(
    ("text", "reason"),
    [
        (checkpoint(2, "c" * 64), "hash of the previous signed one"),
        (checkpoint(1, digest="d" * 64), "another checkpoint 1"),
        (checkpoint(3), "does not follow number 1"),
        (checkpoint(0), "does not follow"),
        (b"", "not an audit checkpoint"),
        (b"rosrv audit checkpoint 1\n", "not an audit checkpoint"),
        (checkpoint(2) + b"x", "not an audit checkpoint"),
        (
            checkpoint(2, digest(checkpoint(1))).replace(b"number 2", b"number 02"),
            "not an audit checkpoint",
        ),
        (checkpoint(2, log="../../../../etc/passwd"), "not an audit checkpoint"),
        (b"\0" * 100_000, "not an audit checkpoint"),
    ],
)
def test_refused(tmp_path: Path, text: bytes, reason: str) -> None:
    signed = CheckpointMemory(tmp_path, wall_ns)
    signed.accept(checkpoint(1))
    before = {path.name: path.read_bytes() for path in tmp_path.iterdir()}
    with pytest.raises(CheckpointRefusedError, match=reason):
        signed.accept(text)
    assert {path.name: path.read_bytes() for path in tmp_path.iterdir()} == before


def test_cut_by_a_crash(tmp_path: Path) -> None:
    first = checkpoint(1)
    second = checkpoint(2, digest(first))
    signed = CheckpointMemory(tmp_path, wall_ns)
    signed.accept(first)
    signed.accept(second)
    (memory,) = tmp_path.glob("*.signed")
    memory.write_bytes(memory.read_bytes()[:-5])
    signed.accept(second)
    assert len(memory.read_bytes()) == 8 + 2 * 32


@contextmanager
def full_after(size: int) -> Iterator[None]:
    """Let the kernel cut each write at this size of its file, as a full disk does at the end of a block."""
    before = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (size, before[1]))
    try:
        yield
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, before)


def test_a_full_disk_signs_nothing_that_is_not_remembered(tmp_path: Path) -> None:
    """Otherwise the next checkpoint would not follow, and no later one could ever be signed."""
    signed, previous, refused = CheckpointMemory(tmp_path, wall_ns), _NONE, 0
    memory = tmp_path / f"{'a' * 32}.signed"
    for number in range(1, 135):
        text = checkpoint(number, previous)
        try:
            with full_after(_BLOCK if number < 130 else 2 * _BLOCK):
                signed.accept(text)
        except OSError as error:
            assert error.filename == str(memory)
            refused += 1
            signed.accept(text)
        previous = digest(text)
    assert refused == 2
    assert memory.stat().st_size == 8 + 134 * 32
