"""Decide by the reports of the lease whether this appliance may serve.

A report has the time to which the lease is valid. If no later time follows, the appliance is passive from that time
on: also if the process of the lease hangs, dies, or is not scheduled.
"""

import asyncio
from collections.abc import Callable

from appliance.base import clock


class LeaseWatch:
    """The role of this appliance: `activate(epoch)` and `passivate()` are called at each change.

    An appliance that is not one of two (`member` is False) is always active.
    """

    def __init__(
        self, *, member: bool, activate: Callable[[int], None], passivate: Callable[[], None]
    ) -> None:
        self.member = member
        self.epoch: int | None = None if member else 0
        self._activate = activate
        self._passivate = passivate
        self._until = 0.0
        self._timer: asyncio.TimerHandle | None = None

    @property
    def active(self) -> bool:
        """Whether this appliance may serve."""
        return self.epoch is not None

    def held(self, until: float, epoch: int) -> None:
        """Take a report: the lease is valid until `until` (seconds of CLOCK_BOOTTIME), in this epoch."""
        if self.epoch not in (None, epoch):
            self.ended()
        self._until = until
        if self.epoch is None and self._left() > 0:
            self.epoch = epoch
            self._activate(epoch)
        self._check()

    def ended(self) -> None:
        """Take a report: the lease is not valid any more."""
        if self._timer is not None:
            self._timer.cancel()
            self._timer = None
        if self.member and self.epoch is not None:
            self.epoch = None
            self._passivate()

    def _check(self) -> None:
        if self._timer is not None:
            self._timer.cancel()
            self._timer = None
        left = self._left()
        if left <= 0:
            self.ended()
        else:
            self._timer = asyncio.get_running_loop().call_later(left, self._check)

    def _left(self) -> float:
        return self._until - clock.since_boot()
