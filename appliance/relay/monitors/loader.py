"""Load compiled specifications beside the loop, so that messages continue while a large set is loaded."""

from collections import deque
from collections.abc import Callable, Hashable
from functools import partial
from typing import TYPE_CHECKING, Union

from appliance.channel.messages import SpecificationsStated
from appliance.relay.loop import EventLoop, WorkBeside

if TYPE_CHECKING:
    from rosmop.run.engine import MonitorSet

Result = Union["MonitorSet", list[str]]


class Loader:
    """Loads statements in the order of arrival, and calls `done(statement, result)` for each."""

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
        self._loading: WorkBeside | None = None

    def later(self, message: SpecificationsStated) -> None:
        self._waiting.append(message)
        if self._loading is None:
            self._begin()

    @property
    def busy(self) -> bool:
        return self._loading is not None or bool(self._waiting)

    def close(self) -> None:
        self._waiting.clear()
        if self._loading is not None:
            self._loading.discard()
            self._loading = None

    def _begin(self) -> None:
        self._loading = self._loop.beside(partial(self.load, self._waiting[0], self._holder_of), self._ready)

    def _ready(self, result: Result) -> None:
        self._loading = None
        self._done(self._waiting.popleft(), result)
        if self._waiting and self._loading is None:  # `done` may have added another message and begun to load
            self._begin()

    @staticmethod
    def load(message: SpecificationsStated, holder_of: Callable[[int], Hashable]) -> Result:
        try:
            from appliance.relay.monitors import monitor_sets  # noqa: PLC0415  half a second of a small machine

            monitor_sets.prepare()
            return monitor_sets.monitor_set(message, holder_of)
        except Exception as error:  # noqa: BLE001  a defect is a reason to refuse, no more
            return [f"a defect of rosrv, please report it: {type(error).__name__}: {error}"]
