"""Test a guard: give synthetic messages to a copy of it, and write its safe message to the driver.

- The copy is made from the text and the values in force, beside the loop. It has its own state and time, so the guard
  in force, its state and its messages are as before, and no motion leaves the copy.
- The safe message goes out once, on the appliance's own connections, and only if the copy stopped.
- *Accepted*: the socket has taken all bytes. *Acknowledged*: the kernel has no byte left that the TCP of the
  subscriber's host has not acknowledged. Whether the node has read it, or obeys, is not seen.
"""

from __future__ import annotations

import fcntl
import struct
import termios
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from typing import TYPE_CHECKING, NamedTuple, Protocol

import msgspec

from appliance.base import clock
from appliance.channel.messages import (
    GivenValue,
    GuardTested,
    GuardTestWanted,
    Message,
    SpecificationsStated,
    SubscriberReached,
)
from appliance.relay.loop import EventLoop, WorkBeside
from appliance.relay.monitors.observer import own_cause
from rosmop.run.outcomes import NOBODY, MessageSender, Outcome

if TYPE_CHECKING:
    from appliance.relay.monitors.interceptor import Interceptor
    from rosmop.run.engine import MonitorSet

_LOOK_SECONDS = 0.002
_MAX_LOOKS = 500
_QUEUED = struct.Struct("i")


class Subscriber(Protocol):
    """A subscriber, as a test looks at it; see `TopicSubscriber` of `connections/served_subscribers.py`."""

    caller_id: str
    host: str

    @property
    def descriptor(self) -> int: ...


class Trial(NamedTuple):
    """The acts of the copy; `begun` is the real time of the stimulus, `safe` its safe message for the command."""

    tested: GuardTested
    begun: float
    safe: bytes | None


class _Copy:
    """A guard alone, in its own time, from `now` on."""

    def __init__(
        self,
        stated: SpecificationsStated,
        given: Mapping[str, Mapping[str, GivenValue]],
        wanted: GuardTestWanted,
        budget: float,
    ) -> None:
        from appliance.relay.monitors import monitor_sets  # noqa: PLC0415  half a second of a small machine

        found = monitor_sets.monitor_set(msgspec.structs.replace(stated, shadows=()), str)
        if isinstance(found, list):
            raise TypeError(found[0])
        self.monitors: MonitorSet = found
        self._wanted, self.now = wanted, clock.wall_ns()
        nodes = ["", *dict.fromkeys(message.node for message in wanted.messages)]
        self._sources = {node: number for number, node in enumerate(nodes)}
        found.limit_time(time.thread_time, budget)
        found.name_senders(lambda source: ("the test", nodes[source]))
        found.start(self.now)
        found.switch({name: name == wanted.monitor for name in found.names}, self.now)
        found.give(given)

    def go_on(self, number: int) -> Iterator[Outcome]:
        """Let the time before a message pass, and give it the message."""
        message, monitors = self._wanted.messages[number], self.monitors
        end = self.now + int(message.after * 1e9)
        while (due := monitors.next_due) is not None and due <= end:
            yield from monitors.advance(due)
        self.now = end
        if message.topic:
            source = self._sources[message.node]
            sender = NOBODY if source == 0 else MessageSender(source)
            yield monitors.judge(message.topic, bytearray(message.data), end, sender)

    def act(self, outcome: Outcome, topic: str) -> str:
        """Return what the guard did to a motion, or an empty text; `topic` is that of the last message."""
        guard, command, monitors = self._wanted.monitor, self._wanted.command, self.monitors
        for sent in outcome.sent_messages():
            if monitors.sends_safe(guard, sent.topic, sent.data) or sent.topic.endswith("/cancel"):
                return "stopped"
        if topic == command and outcome.result == "changed":
            return "stopped" if monitors.sends_safe(guard, command, outcome.buffer) else "limited"
        if topic == command and outcome.result == "dropped":
            return "dropped"
        return "withheld" if monitors.withheld_from(command) else ""


def try_guard(
    stated: SpecificationsStated,
    given: Mapping[str, Mapping[str, GivenValue]],
    wanted: GuardTestWanted,
    budget: float,
) -> Trial:
    """Give the messages to a copy, until it acts after the fault began."""
    copy = _Copy(stated, given, wanted, budget)
    begun, at, passed, act, cause = 0.0, 0, False, "", ""
    for number, message in enumerate(wanted.messages):
        if number == wanted.fault:
            begun, at = clock.now(), copy.now
        act, cause = "", ""
        for outcome in copy.go_on(number):
            act = act or copy.act(outcome, message.topic)
            cause = own_cause(outcome, wanted.monitor) or cause
        if number < wanted.fault:
            passed = not act if message.topic == wanted.command else passed
        elif act:
            break
    return Trial(
        GuardTested(
            wanted.number, "", passed, act, (copy.now - at) / 1e9 if act else 0.0, cause, clock.now() - begun
        ),
        begun,
        copy.monitors.safe_message(wanted.monitor, wanted.command, clock.wall_ns()),
    )


class GuardTrials:
    """One test at a time. `deliver(topic, data)` writes a message to subscribers and returns them."""

    def __init__(
        self,
        loop: EventLoop,
        interceptor: Interceptor,
        deliver: Callable[[str, bytes], Sequence[Subscriber]],
        tell: Callable[[Message], None],
    ) -> None:
        self._loop, self._interceptor = loop, interceptor
        self._deliver, self._tell = deliver, tell
        self._beside: WorkBeside | None = None
        self._era = 0

    def order(self, wanted: GuardTestWanted) -> None:
        found = self._interceptor.copy_source(wanted.monitor)
        why = found if isinstance(found, str) else "another guard is being tested" if self._beside else ""
        if why or isinstance(found, str):
            self._tell(GuardTested(wanted.number, why))
            return
        stated, given = found
        era = self._era

        def work() -> Trial | str:
            try:
                return try_guard(stated, given, wanted, self._interceptor.budget)
            except Exception as error:  # noqa: BLE001  a defect of a copy must not end the relay
                return f"the copy could not be made: {error}"

        self._beside = self._loop.beside(work, lambda trial: self._done(wanted, trial, era))

    def forget(self) -> None:
        """Forget who asked: control has ended, and the next one may give the same number again."""
        self._era += 1

    def close(self) -> None:
        if self._beside is not None:
            self._beside.discard()
            self._beside = None

    def _done(self, wanted: GuardTestWanted, trial: Trial | str, era: int) -> None:
        self._beside = None
        if era != self._era:
            return
        if isinstance(trial, str):
            self._tell(GuardTested(wanted.number, trial))
            return
        tested, safe = trial.tested, trial.safe
        if not (wanted.deliver and tested.passed and tested.act and safe is not None):
            self._tell(tested)
            return
        members = self._deliver(wanted.command, safe)
        rows = {member: SubscriberReached(member.caller_id, member.host, None, None) for member in members}
        tested = msgspec.structs.replace(tested, reached=[*rows.values()])
        self._follow(tested, trial.begun, rows, era)

    def _follow(
        self,
        tested: GuardTested,
        begun: float,
        left: dict[Subscriber, SubscriberReached],
        era: int,
        looks: int = 0,
    ) -> None:
        """Look at the sockets, at once and then every `_LOOK_SECONDS`, and report the result once."""
        for member, row in list(left.items()):
            seconds, descriptor = clock.now() - begun, member.descriptor
            if descriptor < 0:
                continue  # its queue has bytes that the socket has not taken, or it is closed
            row.accepted = seconds if row.accepted is None else row.accepted
            try:
                queued = _QUEUED.unpack(fcntl.ioctl(descriptor, termios.TIOCOUTQ, bytes(_QUEUED.size)))[0]
            except OSError:
                queued = 1
            if queued == 0:
                row.acknowledged = seconds
                del left[member]
        if left and looks < _MAX_LOOKS:
            self._loop.after(_LOOK_SECONDS, lambda: self._follow(tested, begun, left, era, looks + 1))
        elif era == self._era:
            self._tell(tested)
