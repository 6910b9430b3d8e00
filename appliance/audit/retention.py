"""Which old records may go. No I/O.

Records go oldest first, in steps that do not hold up writing, and only as far as a checkpoint seals them (a
signed one, where there is a signer). Every step is itself a record, `records removed`, with the hash that the
chain goes on from.
"""

from dataclasses import dataclass

_DAY = 86_400_000_000_000


@dataclass(frozen=True)
class Retention:
    """Keep records for `days` (None: for ever) and the log below `size` bytes (None: any)."""

    days: float | None = None
    size: int | None = None

    def __post_init__(self) -> None:
        if (self.days is not None and self.days <= 0) or (self.size is not None and self.size < 1 << 20):
            raise ValueError("retention needs more than 0 days and at least 1 MiB")

    def excess(self, size: int) -> str | None:
        """Why the oldest records must go from a log of `size` bytes; None when it is not too large."""
        if self.size is None or size <= self.size:
            return None
        return f"the log was larger than {self.size} bytes"

    def oldest_kept(self, now: int) -> int | None:
        """Records before this time (nanoseconds since the epoch) are too old; None when none is."""
        return None if self.days is None else now - int(self.days * _DAY)
