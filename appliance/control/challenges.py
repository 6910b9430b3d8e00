"""Challenges: what an order over REST is signed under, so that each proof is good once and not for long. No I/O.

A challenge is `ENDS.RANDOM.MAC` under a key of this process. Invariants:

1. Nothing is kept of a challenge that was given: asking for them fills nothing.
2. One is taken once. What was taken is remembered until the challenge has ended; at most `_MOST_TAKEN`, then none is
   taken until some have ended.
3. A new process has a new key: what was signed before a restart is refused after it, without a file to remember it in.
4. Ends are of this process's monotonic clock: neither the asker's clock nor the machine's date has a say.
"""

import hashlib
import hmac
import secrets

SECONDS = 60.0
_MOST_TAKEN = 4096


class ChallengeRefusedError(Exception):
    """The challenge of a proof is not taken; the text says why."""


class Challenges:
    """Gives challenges, and takes each of them once; `now` is seconds of a monotonic clock."""

    def __init__(self) -> None:
        self._key = secrets.token_bytes(32)
        self._taken: dict[str, float] = {}  # by their ends, for all live equally long

    def give(self, now: float) -> str:
        """A new one, good for `SECONDS`."""
        begun = f"{now + SECONDS:.3f}.{secrets.token_urlsafe(16)}"
        return f"{begun}.{self._mac(begun)}"

    def take(self, challenge: str, now: float) -> None:
        """Use it up. Raises `ChallengeRefusedError`."""
        begun, _dot, mac = challenge.rpartition(".")
        if not hmac.compare_digest(mac.encode(), self._mac(begun).encode()):
            raise ChallengeRefusedError(
                "the challenge is none that RVMaster gave since it started: ask for another one"
            )
        ends = float(begun.rpartition(".")[0])
        if ends <= now:
            raise ChallengeRefusedError("the challenge has ended: ask for another one")
        if challenge in self._taken:
            raise ChallengeRefusedError("the proof was used already: each is good once")
        for old in [taken for taken, end in self._taken.items() if end <= now]:
            del self._taken[old]
        if len(self._taken) >= _MOST_TAKEN:
            raise ChallengeRefusedError(f"{_MOST_TAKEN} orders were signed within {SECONDS:g} s: wait")
        self._taken[challenge] = ends

    def _mac(self, begun: str) -> str:
        return hmac.new(self._key, begun.encode(), hashlib.sha256).hexdigest()
