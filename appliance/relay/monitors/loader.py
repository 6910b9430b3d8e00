"""Load compiled specifications in a separate thread, so that messages continue while a large set is loaded. Statements
are loaded one at a time, in the order of arrival. `done` is called in the loop's thread.
"""

import os
import sys
import threading
from collections import deque
from collections.abc import Callable, Hashable
from typing import TYPE_CHECKING, Union

from appliance.channel.messages import SpecificationsStated
from appliance.relay.loop import READ, EventLoop

if TYPE_CHECKING:
    from rosmop.run.engine import MonitorSet

_SWITCH_SECONDS = 0.0005  # the longest time that the loop waits for the loading thread

Result = Union["MonitorSet", list[str]]
"""The monitors, or the errors of the specifications."""


class Loader:
    """The thread that loads specifications and calls `done(statement, result)` for each.

    `holder_of(source)` returns the host that is charged for slices created by messages of a source.
    """

    def __init__(
        self,
        loop: EventLoop,
        done: Callable[[SpecificationsStated, Result], None],
        holder_of: Callable[[int], Hashable],
    ) -> None:
        self._loop = loop
        self._holder_of = holder_of
        self._done = done
        self._waiting: deque[SpecificationsStated] = deque()
        self._thread: threading.Thread | None = None
        self._result: Result = []
        self._wake = -1

    def later(self, message: SpecificationsStated) -> None:
        """Load the specifications of a message while the loop continues."""
        self._waiting.append(message)
        if self._thread is None:
            self._begin()

    @property
    def busy(self) -> bool:
        """Whether something is being loaded or waits to be."""
        return self._thread is not None or bool(self._waiting)

    def close(self) -> None:
        """Wait for the thread, and discard its result."""
        self._waiting.clear()
        if self._thread is not None:
            self._thread.join()
            self._close_wake()
            self._thread = None

    def _begin(self) -> None:
        sys.setswitchinterval(_SWITCH_SECONDS)
        self._wake = os.eventfd(0, os.EFD_NONBLOCK | os.EFD_CLOEXEC)
        self._loop.watch(self._wake, READ, self._ready)
        self._thread = threading.Thread(target=self._work, args=(self._waiting[0], self._wake), daemon=True)
        self._thread.start()

    def _close_wake(self) -> None:
        self._loop.unwatch(self._wake)
        os.close(self._wake)
        self._wake = -1

    def _work(self, message: SpecificationsStated, wake: int) -> None:
        self._result = self.load(message, self._holder_of)
        os.eventfd_write(wake, 1)

    def _ready(self, _events: int) -> None:
        if self._thread is not None:
            self._thread.join()
        self._close_wake()
        self._thread = None
        self._done(self._waiting.popleft(), self._result)
        if self._waiting and self._thread is None:  # `done` may have added another message and begun to load
            self._begin()

    @staticmethod
    def load(message: SpecificationsStated, holder_of: Callable[[int], Hashable]) -> Result:
        """Return the monitors of these specifications, or the errors."""
        try:
            from appliance.relay.monitors import monitor_sets  # noqa: PLC0415  half a second of a small machine

            monitor_sets.prepare()
            return monitor_sets.monitor_set(message, holder_of)
        except Exception as error:  # noqa: BLE001  a defect is a reason to refuse, no more
            return [f"a defect of rosrv, please report it: {type(error).__name__}: {error}"]
