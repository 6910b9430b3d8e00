"""Run the processes of a simulated world in one event loop with virtual time.

Time advances only when no callback is ready. Callbacks of one process keep their order, as asyncio promises; the seed
chooses the process that runs next. A killed process runs no more callbacks, not even its `finally` blocks. The timers
of a process follow the clock of its machine.
"""

import asyncio
import contextlib
import contextvars
import heapq
from collections import deque
from collections.abc import Callable, Coroutine
from dataclasses import dataclass, field
from functools import partial
from random import Random
from typing import Any, TypeVar

from appliance.base import clock

T = TypeVar("T")
_SECOND = 1_000_000_000
_EPOCH = 1_790_000_000.0  # the system time at the beginning of each world
_STEPS_OF_A_MOMENT = 10_000  # without an end: a timer that starts itself again now, for example
_THREAD_SECONDS = (0.0, 0.0, 0.0005, 0.003)  # until the result of a function that runs in a thread


class BrokenPromiseError(AssertionError):
    pass


@dataclass(eq=False)
class Machine:
    """A machine whose clock is `ahead` of the world's time in seconds, and `speed` times as fast."""

    name: str
    loop: "WorldLoop"
    ahead: float = 0.0
    speed: float = 1.0

    def local(self, present: float) -> float:
        return present * self.speed + self.ahead

    def present(self, local: float) -> float:
        return (local - self.ahead) / self.speed

    def now_ns(self) -> int:
        return round(self.local(self.loop.present) * _SECOND)

    since_boot_ns = now_ns

    def wall_ns(self) -> int:
        return round((_EPOCH + self.local(self.loop.present)) * _SECOND)


@dataclass(eq=False)
class Process:
    """A process. `ends` are called when it is killed, as the kernel closes its files and connections."""

    name: str
    machine: Machine
    alive: bool = True
    paused: bool = False  # as by SIGSTOP: its callbacks wait
    ends: list[Callable[[], None]] = field(default_factory=list)
    ready: deque[asyncio.Handle] = field(default_factory=deque)
    doom: tuple[int, Callable[[], None]] | None = None  # what happens after this number of its callbacks
    made: Callable[[Any], None] = lambda _control: None  # called with the parts of a control

    def __post_init__(self) -> None:
        token = _process.set(self)
        with clock.using(self.machine):
            self.context = contextvars.copy_context()
        _process.reset(token)

    def start(self, work: Coroutine[Any, Any, T]) -> asyncio.Task[T]:
        return self.machine.loop.create_task(work, context=self.context.copy())

    def run(self, act: Callable[..., T], *given: Any) -> T:
        return self.context.copy().run(act, *given)

    def call(self, seconds: float, act: Callable[..., object], *given: Any) -> None:
        loop = self.machine.loop
        loop.at(loop.present + seconds, act, given, self.context.copy())

    def step(self) -> None:
        if self.doom is not None:
            left, happen = self.doom
            self.doom = (left - 1, happen) if left > 1 else None
            if self.doom is None:
                happen()

    def kill(self) -> None:
        if self.alive:
            self.alive = False
            self.ready.clear()
            for end in self.ends:
                end()


_process: contextvars.ContextVar[Process] = contextvars.ContextVar("process")


def present_process() -> Process:
    return _process.get()


class WorldLoop(asyncio.BaseEventLoop):
    def __init__(self, random: Random) -> None:
        super().__init__()
        self.present = 0.0
        self.random = random
        self.steps = 0
        self._moment = 0  # the steps before the present moment
        self._waiting: list[Process] = []  # processes with callbacks that are ready
        self.tasks: dict[asyncio.Task[Any], None] = {}
        self.outside = Process("world", Machine("world", self))
        self.set_task_factory(self._make_task)

    def time(self) -> float:
        return self._machine().local(self.present)

    def call_at(  # type: ignore[override]  # the types of arguments do not matter here
        self, when: float, callback: Any, *args: Any, context: contextvars.Context | None = None
    ) -> asyncio.TimerHandle:
        return self.at(self._machine().present(when), callback, args, context)

    def at(
        self, when: float, callback: Any, args: tuple[Any, ...], context: contextvars.Context | None
    ) -> asyncio.TimerHandle:
        return super().call_at(when, callback, *args, context=context)

    def run_in_executor(self, _executor: Any, func: Callable[..., T], *args: Any) -> asyncio.Future[T]:  # type: ignore[override]  # no executor
        future: asyncio.Future[T] = self.create_future()

        def run() -> None:
            if future.cancelled():
                return
            try:
                result = func(*args)
            except Exception as error:  # noqa: BLE001  it is passed to the waiting task
                future.set_exception(error)
            else:
                future.set_result(result)

        self.call_later(self.random.choice(_THREAD_SECONDS), run)
        return future

    def _make_task(self, _loop: asyncio.AbstractEventLoop, work: Any, **more: Any) -> asyncio.Task[Any]:
        task: asyncio.Task[Any] = asyncio.Task(work, loop=self, **more)
        self.tasks[task] = None  # else a killed task would be collected, and run its `finally` blocks
        task.add_done_callback(self.tasks.pop, context=self.outside.context)
        return task

    def add_reader(self, file: Any, act: Callable[..., object], *arguments: Any) -> None:  # type: ignore[override]  # the world's own files
        process = present_process()
        file.readable = lambda: process.run(partial(act, *arguments))

    def remove_reader(self, file: Any) -> None:  # type: ignore[override]  # wider than asyncio's
        file.readable = lambda: None

    def discard(self) -> None:
        for task in [*self.tasks]:
            task._log_destroy_pending = False  # type: ignore[attr-defined]  # they were killed
            with contextlib.suppress(BaseException):
                self.outside.run(task.get_coro().close)
        self.close()

    @staticmethod
    def _machine() -> Machine:
        return _process.get().machine

    def _write_to_self(self) -> None: ...
    def _process_events(self, event_list: Any) -> None: ...

    def _run_once(self) -> None:
        self.steps += 1
        scheduled: list[asyncio.TimerHandle] = self._scheduled  # type: ignore[attr-defined]  # asyncio's own
        ready: deque[asyncio.Handle] = self._ready  # type: ignore[attr-defined]  # typeshed leaves it out
        if not ready and not self._queues():
            while scheduled and scheduled[0].cancelled():
                self._drop_timer()
            if not scheduled:
                raise BrokenPromiseError("deadlock: every task waits")
            if scheduled[0].when() > self.present:
                self.present, self._moment = scheduled[0].when(), self.steps
        if self.steps - self._moment > _STEPS_OF_A_MOMENT:
            raise BrokenPromiseError(f"livelock: {_STEPS_OF_A_MOMENT} steps at {self.present!r} s")
        while scheduled and scheduled[0].when() <= self.present:
            ready.append(self._drop_timer())
        while ready:
            handle = ready.popleft()
            process = handle._context.get(_process)  # type: ignore[attr-defined]  # typeshed leaves it out
            if process is None:
                process = self.outside
            if process.alive and not handle.cancelled():
                if not process.ready:
                    self._waiting.append(process)
                process.ready.append(handle)
        self._run_some()

    def _queues(self) -> list[Process]:
        self._waiting = [process for process in self._waiting if process.ready]
        return [process for process in self._waiting if not process.paused]

    def _run_some(self) -> None:
        waiting = self._queues()
        if not waiting:
            return
        process = waiting[0] if len(waiting) == 1 else self.random.choice(waiting)
        for _ in range(len(process.ready)):
            if not process.ready or process.paused:  # empty: it was killed
                return
            handle = process.ready.popleft()
            if not handle.cancelled():
                handle._run()
                process.step()

    def _drop_timer(self) -> asyncio.TimerHandle:
        scheduled: list[asyncio.TimerHandle] = self._scheduled  # type: ignore[attr-defined]  # typeshed leaves it out
        handle = heapq.heappop(scheduled)
        handle._scheduled = False  # type: ignore[attr-defined]  # typeshed leaves it out
        return handle
