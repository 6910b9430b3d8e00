"""Ticks (`every`), deadlines and safe messages, in the order of their times (ns), which the caller gives.

All ticks up to the present time happen, and all deadlines before it. Ticks beyond the caller's `patience` are
skipped, which is logged; deadlines wait for the next call.

Senders choose the bindings of slices, and thereby how many deadlines pass at one time. So `advance` processes
at most `most` deadlines, and the others stay due; a slice processes its own deadlines before a message.
"""

from collections.abc import Callable, Sequence

from rosmop.run.execution import EXPLAINED, MonitorExecution
from rosmop.run.monitor import MonitorInstance, RunningProperty, Timer
from rosmop.run.outcomes import Outcome

Patience = Callable[[], Callable[[], bool]]

MAX_TICKS = 100_000
"""The most ticks of a timer between two messages. After a larger jump of the clock, the others are skipped."""


class Agenda:
    """The timers and deadlines of monitors."""

    def __init__(
        self,
        monitors: Sequence[MonitorInstance],
        execution: MonitorExecution,
        patience: Patience,
        most: int,
    ) -> None:
        self.due: int | None = None
        self._monitors = monitors
        self._execution = execution
        self._patience = patience
        self._most = most
        self._timed = any(
            monitor.timers
            or monitor.safes
            or any(running.code.property.timed for running in monitor.properties)
            for monitor in monitors
        )

    def let_go(self) -> None:
        for monitor in self._monitors:
            monitor.steps, monitor.timers, monitor.home, monitor.group = (), (), None, None
        self._monitors = ()

    def has_come(self, time_ns: int) -> bool:
        return self.due is not None and self.due <= time_ns

    def schedule(self) -> None:
        """Compute `due`. A deadline passes after its last nanosecond."""
        if not self._timed:
            return
        timer, deadline = self._next_timer(), self._next_deadline()
        times = [timer.due] if timer is not None and timer.due is not None else []
        if deadline is not None:
            times.append(deadline[0] + 1)
        for monitor in self._monitors:
            sending = monitor.sending(passes=self._execution.on_fault == "pass")
            times += [sender.due or 0 for sender in sending]
            for sender in monitor.safes.values():
                if sender not in sending:
                    sender.due = None
        self.due = min(times, default=None)

    def when_due(self, *, anew: bool) -> int | None:
        if anew:
            self.schedule()
        return self.due

    def advance(self, time_ns: int, follow_up: Callable[[Outcome], None]) -> list[Outcome]:
        """Process events in order of time.

        `follow_up(outcome)` is called before the next tick or deadline, which its publications may change.
        """
        outcomes = self.send_safe(time_ns)
        ticks: dict[int, int] = {}
        left = self._most
        over = self._patience()
        self.schedule()  # lanes may have moved deadlines
        for outcome in outcomes:
            follow_up(outcome)
        followed = len(outcomes)
        while self.has_come(time_ns):
            timer = self._next_timer()
            deadline = self._next_deadline(slices=left > 0)
            if timer is not None and timer.due is not None and (deadline is None or timer.due <= deadline[0]):
                if timer.due > time_ns:
                    break
                outcomes.append(self._tick(timer, time_ns, ticks))
            elif deadline is not None and deadline[0] < time_ns:
                _, monitor, running = deadline
                left -= running is None
                explains = self._most - left <= EXPLAINED
                outcomes += self._execution.expire(monitor, running, explains=explains)
            else:
                break
            for outcome in outcomes[followed:]:
                follow_up(outcome)
            followed = len(outcomes)
            self.schedule()
            if self.has_come(time_ns) and over():
                outcomes.append(self._leave_out(time_ns))
                self.schedule()
                break
        for outcome in outcomes[followed:]:
            follow_up(outcome)
        return outcomes

    def send_safe(self, time_ns: int) -> list[Outcome]:
        """Send the safe messages that are due, each at most once, because missed ones are of no use."""
        outcomes = []
        for monitor in self._monitors:
            for sender in monitor.sending(passes=self._execution.on_fault == "pass"):
                if (sender.due or 0) <= time_ns:
                    outcomes.append(self._execution.send_safe(monitor, sender, time_ns))
        return outcomes

    def _tick(self, timer: Timer, time_ns: int, ticks: dict[int, int]) -> Outcome:
        due = timer.due or 0
        timer.ticked = True
        timer.due = due + timer.period
        outcome = self._execution.tick(timer.step, due)
        ticks[id(timer)] = ticks.get(id(timer), 0) + 1
        if ticks[id(timer)] >= MAX_TICKS and timer.due <= time_ns:
            self._skip(timer, time_ns, "the clock has jumped")
        self._execution.collect(outcome)
        return outcome

    def _leave_out(self, time_ns: int) -> Outcome:
        outcome = Outcome(time=time_ns)
        for monitor in self._monitors:
            for timer in monitor.timers:
                if monitor.enabled and timer.due is not None and timer.due <= time_ns:
                    self._skip(timer, time_ns, "they take too long")
        self._execution.collect(outcome)
        return outcome

    def _skip(self, timer: Timer, time_ns: int, reason: str) -> None:
        due = timer.due or 0
        left_out = (time_ns - due) // timer.period + 1
        timer.due = due + left_out * timer.period
        timer.step.monitor.touch()
        text = f"{left_out} ticks of {timer.step.name} were skipped: {reason}"
        self._execution.warn(timer.step.monitor, text)

    def _next_timer(self) -> Timer | None:
        timers = [
            timer
            for monitor in self._monitors
            if monitor.enabled
            for timer in monitor.timers
            if timer.due is not None
        ]
        return min(timers, key=lambda timer: timer.due or 0, default=None)

    def _next_deadline(
        self, *, slices: bool = True
    ) -> tuple[int, MonitorInstance, RunningProperty | None] | None:
        found: tuple[int, MonitorInstance, RunningProperty | None] | None = None
        for monitor in self._monitors:
            if monitor.enabled and monitor.slices is not None:
                deadline = monitor.slices.deadline if slices else None
                if deadline is not None and (found is None or deadline < found[0]):
                    found = (deadline, monitor, None)
            elif monitor.enabled:
                for running in monitor.properties:
                    if running.code.property.timed:
                        monitor.move_to_python()
                    deadline = running.run.deadline
                    if deadline is not None and (found is None or deadline < found[0]):
                        found = (deadline, monitor, running)
        return found
