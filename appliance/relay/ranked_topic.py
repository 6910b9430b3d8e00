"""Decide which publisher of a topic with a rank is heard. No I/O; times are seconds of one monotonic clock.

A publisher has a rank; 0 is the highest. A message *moves* unless it is a zero.

    UNKNOWN --rank 0 moves--> MOVING --zero, then `free` seconds--> FREE --any rank moves--> MOVING
                              MOVING --`LOST` seconds of silence, or its connection ends--> LOST

1. Only the driver is heard, and its messages always are.
2. A higher rank becomes the driver with its first message that moves. Its zeros before that do not pass: they are those
   of a gamepad at rest.
3. A lower rank becomes the driver only while the topic is FREE, with a message that was sent after the driver let go.
   Earlier ones, which waited in a connection, are read and dropped first: while the driver's `free` time runs, so that
   this takes no further time, or for `SETTLE` seconds after a pause of the process or the order of an operator.
4. Silence after a motion is not letting go: the topic is LOST until the driver returns, its own or a higher rank moves,
   or an operator hands it back (`free`). A driver whose type has no velocity never lets go.
5. A relay that does not know who moves begins as if rank 0 had been LOST. One that knows listens first: it drops a
   lower rank until all higher ones have been connected for `LISTEN` seconds, or for `LISTEN_MOST` if they cannot be.
   It notes who moves in this time, and passes zeros of the driver, which stop the base.
"""

from collections.abc import Callable, Collection
from dataclasses import dataclass

from appliance.channel.messages.relay_link import RankPlace, RankStanding

LOST_SECONDS = 2.0
"""Silence after a motion, after which the driver is reported as lost. Lower ranks wait from the motion on."""
SETTLE_SECONDS, STALL_SECONDS = 0.08, 0.04
"""The time in which all has been read that was sent before, if the process did not pause for longer than `STALL`."""
MAX_PAUSES = 20
"""Those that delay a hand-back. A process that pauses more often is so slow that lower ranks would wait for ever."""
LISTEN_SECONDS, LISTEN_MOST_SECONDS = 1.0, 5.0


@dataclass(frozen=True, slots=True)
class RankDriver:
    """The driver of a topic, or the last one; `key` is empty if none is known."""

    key: str
    rank: int
    standing: RankStanding


class RankedTopic:
    """The driver of one topic among its publishers, by their nodes' keys. `changed` gets each new state."""

    def __init__(self, known: RankPlace, now: float, changed: Callable[[RankDriver], None]) -> None:
        self._free = known.free
        self._changed = changed
        self._ranks: dict[str, int] = {}
        self._driver = RankDriver(known.driver, known.driver_rank, known.standing)
        self._at = now  # the last motion; or the first zero after it, if the driver `lets_go`
        self._lets_go = False
        self._settled: float | None = None  # None: lower ranks may move if the topic is free
        self._seen, self._pauses = now, 0
        self._settle(now)
        self._listens_until = now + LISTEN_SECONDS
        self._listens_most = now + LISTEN_MOST_SECONDS
        self._open: set[str] = set()

    @property
    def driver(self) -> RankDriver:
        return self._driver

    @property
    def is_settling(self) -> bool:
        """Whether `expire` must be called several times in `STALL_SECONDS`, so that a pause of the process shows."""
        return self._settled is not None

    @property
    def keys(self) -> Collection[str]:
        return self._ranks.keys()

    def place(self, key: str, rank: int, free: float) -> None:
        self._ranks[key] = rank
        self._free = free
        if key == self._driver.key and rank != self._driver.rank:
            self._become(RankDriver(key, rank, self._driver.standing))

    def withdraw(self, key: str, now: float) -> None:
        """Forget a publisher; its node has ended, or the policy gives it no rank any more."""
        self.lose(key, now)
        self._ranks.pop(key, None)

    def opened(self, key: str, now: float) -> None:
        self._open.add(key)
        if now < self._listens_most:
            self._listens_until = now + LISTEN_SECONDS

    def lose(self, key: str, now: float) -> None:
        """Note that the connection to a publisher has ended."""
        self._open.discard(key)
        self.expire(now)
        if key == self._driver.key and self._driver.standing == "moving" and not self._lets_go:
            self._become(RankDriver(key, self._driver.rank, "lost"))

    def free(self, now: float) -> None:
        """Hand the topic back, as ordered by an operator."""
        self._settle(now)
        self._become(RankDriver("", self._driver.rank, "free"), always=True)

    def expire(self, now: float) -> float | None:
        """Note what time has ended; return the time of the next such end, or None."""
        due = None
        if self._driver.standing == "moving":
            due = self._at + (self._free if self._lets_go else LOST_SECONDS)
            if self._lets_go:
                self._settled = max(due, self._settled or due)
        self._read_on(now)
        if due is None:
            return self._settled
        if now < due:
            return due
        standing: RankStanding = "free" if self._lets_go else "lost"
        self._lets_go = False
        self._become(RankDriver(self._driver.key, self._driver.rank, standing))
        return self._settled

    def _read_on(self, now: float) -> None:
        if self._settled is None:
            return
        if now - self._seen > STALL_SECONDS and self._pauses < MAX_PAUSES:
            settled = max(self._settled, now + SETTLE_SECONDS)  # what came in the pause is not read yet
            self._pauses += settled > self._settled
            self._settled = settled
        elif now >= self._settled:
            self._settled = None
        self._seen = now

    def hears(self, key: str, now: float) -> bool:
        """Whether messages of this publisher that were taken before may still pass."""
        return key == self._driver.key and not self._is_deaf(key, now)

    def passes(self, key: str, *, moves: bool, now: float) -> bool:
        """Take a message, and return whether it passes."""
        self.expire(now)
        rank = self._ranks.get(key)
        if rank is None:
            return False
        driver = self._driver
        if key != driver.key and (not moves or not self._may_begin(rank)):
            return False
        if moves:
            self._at, self._lets_go, self._settled = now, False, None
            self._become(RankDriver(key, rank, "moving"))
        elif not self._lets_go and driver.standing in ("moving", "lost"):
            self._at, self._lets_go = now, True
            self._settled, self._seen, self._pauses = now + self._free, now, 0
            self._become(RankDriver(key, rank, "moving"))
        return not moves or not self._is_deaf(key, now)

    def _may_begin(self, rank: int) -> bool:
        driver = self._driver
        match driver.standing:
            case "free":
                return self._settled is None or rank < driver.rank
            case "moving":
                return rank < driver.rank
            case "lost" | "unknown":
                return rank <= driver.rank

    def _is_deaf(self, key: str, now: float) -> bool:
        """Whether the relay still listens for ranks above that of this publisher."""
        if now >= self._listens_most:
            return False
        rank = self._ranks.get(key, 0)
        higher = {other for other, its in self._ranks.items() if its < rank}
        return rank > 0 and (now < self._listens_until or not higher <= self._open)

    def _settle(self, now: float) -> None:
        self._lets_go = False
        self._settled = now + SETTLE_SECONDS
        self._seen, self._pauses = now, 0

    def _become(self, driver: RankDriver, *, always: bool = False) -> None:
        if driver != self._driver or always:
            self._driver = driver
            self._changed(driver)
