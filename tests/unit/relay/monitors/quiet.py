"""Monitors without sockets, threads and clocks, with statements and messages as input and reports as output."""

import math
from collections.abc import Callable
from typing import Any, TypeVar

from appliance.channel.messages import Message, SpecificationsTaken
from appliance.relay.loop import EventLoop, LoopTimer, WorkBeside
from appliance.relay.monitors.interceptor import Interceptor
from appliance.relay.monitors.observation_points import NOWHERE
from appliance.relay.relay_limits import RelayLimits
from appliance.relay.report import Reporter
from rosmop.run.outcomes import Outcome, Published
from tests.support.stated import stated
from tests.unit.relay.world import HeldWork

T = TypeVar("T")


class Timers(EventLoop):
    """A loop that never turns. `due` has its timers, and `finish` does the work beside it."""

    def __init__(self) -> None:
        super().__init__()
        self.due: list[tuple[float, LoopTimer]] = []
        self._work: list[HeldWork] = []

    def over(self) -> bool:
        return False

    def beside(self, work: Callable[[], T], done: Callable[[T], None]) -> WorkBeside:
        self._work.append(HeldWork(lambda: done(work())))
        return self._work[-1]

    def finish(self) -> None:
        while self._work:
            if (do := self._work.pop(0).do) is not None:
                do()

    def after(self, seconds: float, callback: Callable[[], None]) -> LoopTimer:
        timer = LoopTimer(callback)
        self.due.append((seconds, timer))
        return timer

    def run_due(self) -> None:
        """Call the timers that are due now, in their order."""
        due, self.due = sorted(self.due, key=lambda one: one[0]), []
        for _seconds, timer in due:
            if timer.callback is not None:
                timer.callback()


class Reports(Reporter):
    """The reports of a relay to control, in `sent`."""

    def __init__(self) -> None:
        super().__init__(RelayLimits())
        self.sent: list[Message] = []

    @property
    def attached(self) -> bool:
        return True

    def send(self, message: Message) -> None:
        self.sent.append(message)


class QuietMonitors:
    def __init__(self, publish: Callable[[str, bytes], None] | None = None, late: float = math.inf) -> None:
        self.reports = Reports()
        self.published: list[tuple[str, bytes]] = []
        self.called: list[Published] = []
        self._send = publish or (lambda topic, data: self.published.append((topic, data)))
        self.loop = Timers()
        self.interceptor = Interceptor(
            self.loop,
            self.reports,
            budget=1.0,
            publish=self._publish,
            changed=lambda _topics: None,
            late=late,
        )

    def _publish(self, message: Published) -> None:
        if message.is_call:
            self.called.append(message)
        else:
            self._send(message.topic, message.data)

    def load(self, *texts: str, **more: Any) -> SpecificationsTaken:
        files = [(f"{number}.rv", text) for number, text in enumerate(texts)]
        self.interceptor.state(stated(1, files, {}, **more))
        self.loop.finish()
        answer = self.reports.sent[-1]
        assert isinstance(answer, SpecificationsTaken)
        return answer

    def process(self, topic: str, data: bytes, time: int = 1) -> Outcome:
        assert self.interceptor.monitors is not None
        outcome = self.interceptor.monitors.process(topic, data, time)
        self.interceptor.observer.report(outcome, NOWHERE)
        return outcome
