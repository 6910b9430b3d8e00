"""What the signer remembers of the audit checkpoints it signed, so that no second past can be signed.

Invariants:
1. For each log the hashes of its signed checkpoints stand in `<log>.signed`, by number; it only ever grows.
2. A checkpoint is approved if it follows the last one (number and hash), or if it is exactly the one approved
   under its number before (control lost the answer). A log that is not known yet may begin with any number.
3. At most `MOST_LOGS` logs are remembered; a further one is refused, so control cannot fill the signer's disk
   with names.
"""

import hashlib
import os
import re
from pathlib import Path

MOST_LOGS = 64
_HASH = 32
_HEADER = 8
_CHECKPOINT = re.compile(
    rb"rosrv audit checkpoint 1\nlog ([0-9a-f]{32})\nnumber (\d{1,18})\nsequence \d{1,18}\n"
    rb"hash [0-9a-f]{64}\ntime \d{1,19}\nprevious ([0-9a-f]{64})\n"
)


class CheckpointRefusedError(Exception):
    """A checkpoint that must not be signed; the message says why."""


class SignedCheckpoints:
    """The memory of one signer, in its directory."""

    def __init__(self, directory: Path) -> None:
        self._directory = directory

    def approve(self, text: bytes) -> None:
        """Remember a checkpoint as signed. Raises `CheckpointRefusedError`; `OSError` from the disk."""
        match = _CHECKPOINT.fullmatch(text)
        if match is None:
            raise CheckpointRefusedError("what was to be signed is not an audit checkpoint")
        log, number, previous = match[1].decode(), int(match[2]), bytes.fromhex(match[3].decode())
        path = self._directory / f"{log}.signed"
        digest = hashlib.sha256(text).digest()
        if not path.exists():
            self._begin(path, number, digest)
            return
        descriptor = os.open(path, os.O_RDWR | os.O_CLOEXEC)
        try:
            _add(descriptor, number, previous, digest)
        finally:
            os.close(descriptor)

    def _begin(self, path: Path, number: int, digest: bytes) -> None:
        if len(list(self._directory.glob("*.signed"))) >= MOST_LOGS:
            raise CheckpointRefusedError(
                f"{MOST_LOGS} logs were signed before; remove .signed files of old ones in {self._directory}"
            )
        making = path.with_name(path.name + ".new")
        with making.open("wb") as file:
            file.write(number.to_bytes(_HEADER, "big") + digest)
            file.flush()
            os.fsync(file.fileno())
        making.rename(path)


def _add(descriptor: int, number: int, previous: bytes, digest: bytes) -> None:
    first = int.from_bytes(os.pread(descriptor, _HEADER, 0), "big")
    count = (os.fstat(descriptor).st_size - _HEADER) // _HASH  # a hash cut short by a crash was not approved
    index = number - first
    if index < 0 or index > count:
        raise CheckpointRefusedError(f"checkpoint {number} does not follow number {first + count - 1}")
    if index < count:
        if os.pread(descriptor, _HASH, _HEADER + index * _HASH) != digest:
            raise CheckpointRefusedError(f"another checkpoint {number} of this log was signed before")
        return
    if os.pread(descriptor, _HASH, _HEADER + (count - 1) * _HASH) != previous:
        raise CheckpointRefusedError(
            f"checkpoint {number} does not carry the hash of the one signed before it"
        )
    os.pwrite(descriptor, digest, _HEADER + count * _HASH)
    os.fsync(descriptor)
