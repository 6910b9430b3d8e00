"""A process of the appliance in memory, for a supervisor whose handles, slots and messages are real."""

import asyncio
import itertools
import signal
from collections.abc import Callable

from appliance.channel.messages import Lifeline, Message
from appliance.supervisor.process_handle import ChildProcess, ProcessCallbacks, ProcessHandle
from tests.support.memory_channel import memory_link

_pids = itertools.count(4_300_000)  # above all processes of a machine
_UNHEARD = ProcessCallbacks(lambda *_: None, lambda *_: None, lambda *_: None)


class MemoryChild(ChildProcess):
    """It lives until `end`, or until the message or signal with the name `ends_by` comes.

    `hears` is called with the name of each message and signal.
    """

    def __init__(
        self,
        role: str = "control",
        reports: ProcessCallbacks = _UNHEARD,
        *,
        is_program: bool = False,
        ends_by: str = "",
        hears: Callable[[str], object] = lambda _name: None,
    ) -> None:
        self.pid, self.is_program, self._ends_by, self._hears = next(_pids), is_program, ends_by, hears
        self.signals: list[signal.Signals] = []
        self.stalled, self._status = 0.0, 0
        self._lifeline, supervisors = memory_link(Lifeline)
        self._lifeline.attach(asyncio.get_running_loop(), self._received, lambda: None)
        self.handle = ProcessHandle(role, 0, self, supervisors, reports)

    @property
    def told(self) -> list[Message]:
        self._lifeline.deliver()
        return self._lifeline.messages

    @property
    def is_killed(self) -> bool:
        return signal.SIGKILL in self.signals

    def end(self, status: int) -> None:
        self._status = status
        self._died()

    def _received(self, message: Message, _descriptors: tuple[int, ...]) -> None:
        self._hear(type(message).__name__, 0)

    def _hear(self, name: str, status: int) -> None:
        self._hears(name)
        if name == self._ends_by:
            self.end(status)

    def watch(self, died: Callable[[], None]) -> None:
        self._died = died

    def wait(self) -> int:
        return self._status

    def send_signal(self, number: signal.Signals) -> None:
        self.signals.append(number)
        self._hear(number.name, -number)

    def stalled_seconds(self) -> float:
        return self.stalled
