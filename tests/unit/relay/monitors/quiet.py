"""Monitors without sockets, threads and clocks, with statements and messages as input and reports as output."""

from collections.abc import Callable
from typing import Any

from appliance.channel.messages import Message, SpecificationsTaken
from appliance.relay.loop import LoopTimer
from appliance.relay.monitors.interceptor import Interceptor
from appliance.relay.monitors.observation_points import NOWHERE
from rosmop.run.outcomes import Outcome, Published
from tests.support.stated import stated


class Timers:
    def __init__(self) -> None:
        self.due: list[tuple[float, LoopTimer]] = []
        self._work: list[Callable[[], None]] = []

    def over(self) -> bool:
        return False

    def beside(self, work: Callable[[], Any], done: Callable[[Any], None]) -> "Timers":
        self._work.append(lambda: done(work()))
        return self

    def finish(self) -> None:
        while self._work:
            self._work.pop(0)()

    def discard(self) -> None:
        self._work.clear()

    def after(self, seconds: float, callback: Callable[[], None]) -> LoopTimer:
        timer = LoopTimer(callback)
        self.due.append((seconds, timer))
        return timer


class Reports:
    attached = True

    def __init__(self) -> None:
        self.sent: list[Message] = []

    def send(self, message: Message) -> None:
        self.sent.append(message)


class QuietMonitors:
    def __init__(self, publish: Callable[[str, bytes], None] | None = None) -> None:
        self.reports = Reports()
        self.published: list[tuple[str, bytes]] = []
        self.called: list[Published] = []
        self._send = publish or (lambda topic, data: self.published.append((topic, data)))
        self.loop = Timers()
        loop: Any = self.loop
        reporter: Any = self.reports
        self.interceptor = Interceptor(
            loop,
            reporter,
            budget=1.0,
            publish=self._publish,
            changed=lambda _topics: None,
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
