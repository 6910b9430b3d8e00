"""A clock for `appliance.base.clock.using` that moves only when a test moves it."""

from appliance.base import clock

_SECOND = 1_000_000_000


class VirtualClock:
    """A clock that starts at `now` and `wall` in seconds; the default of `wall` is the present time."""

    def __init__(self, *, wall: float | None = None, now: float = 1000.0) -> None:
        self._now = round(now * _SECOND)
        self._wall = clock.wall_ns() if wall is None else round(wall * _SECOND)
        self._asleep = 0

    def now_ns(self) -> int:
        return self._now

    def wall_ns(self) -> int:
        return self._wall

    def since_boot_ns(self) -> int:
        return self._now + self._asleep

    def advance(self, seconds: float) -> None:
        self.advance_ns(round(seconds * _SECOND))

    def advance_ns(self, nanoseconds: int) -> None:
        self._now += nanoseconds
        self._wall += nanoseconds

    def sleep(self, seconds: float) -> None:
        self._asleep += round(seconds * _SECOND)
        self._wall += round(seconds * _SECOND)

    def set_wall(self, seconds: float) -> None:
        self._wall = round(seconds * _SECOND)


class ShiftedClock:
    def __init__(self, ahead: float) -> None:
        present = clock.source()
        self.now_ns, self.since_boot_ns = present.now_ns, present.since_boot_ns
        self.wall_ns = lambda: present.wall_ns() + round(ahead * _SECOND)


def let_time_pass(seconds: float) -> None:
    present = clock.source()
    assert isinstance(present, VirtualClock)
    present.advance(seconds)


def set_wall(seconds: float) -> None:
    present = clock.source()
    assert isinstance(present, VirtualClock)
    present.set_wall(seconds)
