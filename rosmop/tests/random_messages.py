import math
import struct
from collections.abc import Sequence
from random import Random

from rosmop.fast.abi import MAX_KEPT
from roswire.definitions import Definitions
from roswire.message_text import PRIMITIVES, Field

FLOATS = (
    0.0, -0.0, 0.5, 1.0, 2.5, -2.5, 7.0, 300.0, 1e300, -1e300, 1e-320, 2.0**63,
    *map(float, ("inf", "-inf", "nan")),
)  # fmt: skip
TEXTS = (
    b"", b"a", b"b", b"abc", b"abd", b"arm", b"a\0b", b"\xe4\n", b"\xff%s\0", b"x" * 64, b"x" * 65,
    b"y" * (MAX_KEPT + 1),
)  # fmt: skip
LIES = (0, 1, 3, 4, 200, 2**29, 2**31 - 1, 2**31, 2**32 - 5, 2**32 - 1)


class RandomMessages:
    """Most numbers are small, so that conditions of programs are sometimes true."""

    def __init__(self, definitions: Definitions, random: Random) -> None:
        self._definitions = definitions
        self._random = random

    def whole(self, kind: str) -> bytes:
        return b"".join(map(self._field, self._definitions.message(kind).fields))

    def read(self, kind: str) -> list[bytes]:
        random, whole = self._random, self.whole(kind)
        bodies = [
            whole if random.random() < 0.3 else self.whole(kind) for _ in range(random.choice((1, 2, 6, 12)))
        ]
        if whole and random.random() < 0.5:
            bodies[random.randrange(len(bodies))] = whole[: random.randrange(len(whole))]
        if len(whole) > 4 and random.random() < 0.5:
            wrong = lie(whole, random.randrange(len(whole) - 3), random.choice(LIES))
            bodies[random.randrange(len(bodies))] = wrong
        return bodies

    def _field(self, field: Field) -> bytes:
        if not field.is_array:
            return self._value(field.type)
        length = self._random.choice((0, 1, 2, 3, 5, 7)) if field.length is None else field.length
        head = struct.pack("<I", length) if field.length is None else b""
        return head + b"".join(self._value(field.type) for _ in range(length))

    def _value(self, kind: str) -> bytes:
        random = self._random
        if kind == "string":
            text = random.choice(TEXTS)
            return struct.pack("<I", len(text)) + text
        if kind not in PRIMITIVES:
            return self.whole(kind)
        code, size = PRIMITIVES[kind]
        if code == "f":
            return struct.pack(
                "<f", random.choice([value for value in FLOATS if not 1e38 < abs(value) < math.inf])
            )
        if code == "d":
            return struct.pack("<d", random.choice(FLOATS))
        if random.random() < 0.8:
            return random.choice((0, 1, 1, 2, 3, 4, 5, 6, 7, 8)).to_bytes(size, "little")
        low = b"\0" * (size - 1)
        return random.choice(
            (b"\xff" * size, low + b"\x80", low.replace(b"\0", b"\xff") + b"\x7f", random.randbytes(size))
        )


def cuts(whole: bytes) -> list[bytes]:
    return [body for end in range(len(whole)) for body in (whole, whole[:end])]


def lie(whole: bytes, at: int, length: int) -> bytes:
    return whole[:at] + struct.pack("<I", length) + whole[at + 4 :]


def lies(whole: bytes, random: Random, lengths: Sequence[int] = LIES) -> list[bytes]:
    places = sorted(random.sample(range(len(whole) - 3), k=min(12, len(whole) - 3))) if len(whole) > 4 else []
    return [body for at in places for length in lengths for body in (lie(whole, at, length), whole)]
