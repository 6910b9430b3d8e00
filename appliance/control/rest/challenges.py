"""Issue challenges for signed REST orders, so that each proof is valid once and only for a short time. No I/O.

A challenge is `ENDS.RANDOM.MAC`; the MAC uses a key of this process. Invariants:

1. Issued challenges are not stored, so requests for challenges cannot exhaust memory.
2. A challenge is accepted once. Accepted challenges are stored until they expire. While `_MOST_TAKEN` challenges are
   stored, no further challenge is accepted.
3. A new process has a new key, so an order that was signed before a restart is rejected after the restart.
4. Challenges expire by this process's monotonic clock. The client's clock and the machine's date do not matter.
"""

import hashlib
import hmac
import secrets

SECONDS = 60.0
_MOST_TAKEN = 4096


class ChallengeRefusedError(Exception):
    """The challenge of a proof is not accepted; the message gives the reason."""


class Challenges:
    """The challenges of this process, each accepted once; `now` is in seconds of a monotonic clock."""

    def __init__(self) -> None:
        self._key = secrets.token_bytes(32)
        self._taken: dict[str, float] = {}  # accepted challenges, with the time at which they expire

    def give(self, now: float) -> str:
        """Return a new challenge, valid for `SECONDS`."""
        begun = f"{now + SECONDS:.3f}.{secrets.token_urlsafe(16)}"
        return f"{begun}.{self._mac(begun)}"

    def take(self, challenge: str, now: float) -> None:
        """Accept a challenge, once. Raises `ChallengeRefusedError`."""
        begun, _dot, mac = challenge.rpartition(".")
        if not hmac.compare_digest(mac.encode(), self._mac(begun).encode()):
            raise ChallengeRefusedError(
                "RVMaster has not issued this challenge since it started: request another one"
            )
        ends = float(begun.rpartition(".")[0])
        if ends <= now:
            raise ChallengeRefusedError("the challenge has expired: request another one")
        if challenge in self._taken:
            raise ChallengeRefusedError("the proof was already used: each is valid once")
        for old in [taken for taken, end in self._taken.items() if end <= now]:
            del self._taken[old]
        if len(self._taken) >= _MOST_TAKEN:
            raise ChallengeRefusedError(f"{_MOST_TAKEN} orders were signed within {SECONDS:g} s: wait")
        self._taken[challenge] = ends

    def _mac(self, begun: str) -> str:
        return hmac.new(self._key, begun.encode(), hashlib.sha256).hexdigest()
