"""Specifications become monitors beside the loop, so that messages go on while a large set is compiled.

One statement at a time, in the order they came; `done` is called by the loop. Only what has no specifications is
"compiled" at once.
"""

import os
import sys
import threading
import time
from collections import deque
from collections.abc import Callable

from appliance.channel.messages import SpecificationsStated
from appliance.relay.loop import READ, Loop
from appliance.ros.definitions import Definitions
from appliance.ros.errors import DefinitionError
from appliance.ros.standard import standard_definitions
from appliance.rosmop.certify.properties import certificates_of
from appliance.rosmop.engine import MonitorSet
from appliance.rosmop.syntax.errors import SpecificationError

_SWITCH_SECONDS = 0.0005  # the loop waits so long at most for the compiler
_TICKS_SECONDS = 0.2  # of processor time that ticks and deadlines may take in one go
_TRIAL_TICKS_SECONDS = 0.02

Result = MonitorSet | list[str]
"""The monitors, or what is wrong with the specifications."""


class Compiler:
    """Compiles statements; `done(statement, result)` hears of each."""

    def __init__(self, loop: Loop, done: Callable[[SpecificationsStated, Result], None]) -> None:
        self._loop = loop
        self._done = done
        self._standard: Definitions | None = None
        self._waiting: deque[SpecificationsStated] = deque()
        self._thread: threading.Thread | None = None
        self._result: Result = []
        self._wake = -1

    def now(self, message: SpecificationsStated) -> None:
        """Compile at once."""
        self._done(message, self.compile(message))

    def later(self, message: SpecificationsStated) -> None:
        """Compile while the loop goes on."""
        self._waiting.append(message)
        if self._thread is None:
            self._begin()

    @property
    def busy(self) -> bool:
        """Whether something is being compiled, or waits for it."""
        return self._thread is not None or bool(self._waiting)

    def close(self) -> None:
        """Wait for the one that is being compiled; its result is nobody's."""
        self._waiting.clear()
        if self._thread is not None:
            self._thread.join()
            self._loop.unwatch(self._wake)
            os.close(self._wake)
            self._thread = None

    def _begin(self) -> None:
        if self._wake < 0:
            sys.setswitchinterval(_SWITCH_SECONDS)
        self._wake = os.eventfd(0, os.EFD_NONBLOCK | os.EFD_CLOEXEC)
        self._loop.watch(self._wake, READ, self._ready)
        self._thread = threading.Thread(target=self._work, args=(self._waiting[0], self._wake), daemon=True)
        self._thread.start()

    def _work(self, message: SpecificationsStated, wake: int) -> None:
        self._result = self.compile(message)
        os.eventfd_write(wake, 1)

    def _ready(self, _events: int) -> None:
        if self._thread is not None:
            self._thread.join()
        self._loop.unwatch(self._wake)
        os.close(self._wake)
        self._thread = None
        self._done(self._waiting.popleft(), self._result)
        if self._waiting and self._thread is None:  # `done` may have brought others, and begun
            self._begin()

    def compile(self, message: SpecificationsStated) -> Result:
        """The set that these specifications make, or what is wrong with them."""
        try:
            if not message.files:
                return MonitorSet.load({}, Definitions({}), message.on_fault, _patience)
            if self._standard is None:
                self._standard = standard_definitions()
            definitions = self._standard.extended(Definitions.from_files(message.definitions))
            monitors = MonitorSet.load(
                dict(message.files),
                definitions,
                message.on_fault,
                _patience,
                trials=message.trials,
                trial_patience=lambda: _patience(_TRIAL_TICKS_SECONDS),
                margins=True,
                slices=message.slices,
            )
            for part in (monitors, *monitors.trials):
                _, wrong = certificates_of(
                    part.monitors
                )  # control has checked its own: these are what will judge
                if wrong:
                    return [str(finding) for finding in wrong]
            monitors.write_module()
            return monitors
        except SpecificationError as error:
            return [str(finding) for finding in error.findings]
        except DefinitionError as error:
            return [str(error)]
        except Exception as error:  # noqa: BLE001  a defect of the compiler is a reason to refuse, no more
            return [f"a defect of rosrv, please report it: {type(error).__name__}: {error}"]


def _patience(seconds: float = _TICKS_SECONDS) -> Callable[[], bool]:
    ends = time.thread_time() + seconds
    return lambda: time.thread_time() > ends
