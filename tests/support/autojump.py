"""An event loop with virtual time, so that a test never waits and runs the same way each time.

When no callback is ready, the clock jumps to the next timer. Without a timer, `DeadlockError` names the waiting
tasks. A function passed to `to_thread` runs in the loop. Sockets, signals, programs and calls from other threads
raise `RealLoopError`; `LocalLoop` has the sockets of `local_sockets.py`.
"""

import asyncio
import contextlib
import math
import selectors
import threading
from collections.abc import Callable, Coroutine, Iterator
from contextvars import Context
from types import CoroutineType
from typing import TYPE_CHECKING, Any, Never, TypeVar, TypeVarTuple

import pytest

from appliance.base import clock
from tests.support.determinism import may_depend_on_chance
from tests.support.virtual_clock import VirtualClock

_Result = TypeVar("_Result")
_Arguments = TypeVarTuple("_Arguments")
_MAX_JUMPS = 200_000


class DeadlockError(Exception):
    pass


class RealLoopError(Exception):
    pass


class _JumpingLoop(asyncio.BaseEventLoop):
    """The part that both loops share. They must be used inside `clock.using(machine)`, as `autojump` does."""

    machine: VirtualClock
    _jumps = 0
    _most_jumps = _MAX_JUMPS
    _thread_id: int | None  # of the thread that runs the loop

    def time(self) -> float:
        return self.machine.now_ns() / 1e9

    def _jump(self, timeout: float | None) -> None:
        if timeout is None:
            raise DeadlockError(f"deadlock: {self._waiting()}")
        if timeout > 0:
            self._jumps += 1
            if self._jumps > self._most_jumps:
                raise DeadlockError(f"{self._most_jumps} timers have passed in vain: {self._waiting()}")
            self.machine.advance_ns(math.ceil(timeout * 1e9))
        # A timer is due if it is later by less than this: after a year, a float has steps of more than a nanosecond.
        self._clock_resolution = max(1e-9, 2 * math.ulp(self.time()))

    def _write_to_self(self) -> None: ...

    def _waiting(self) -> str:
        tasks = sorted(asyncio.all_tasks(self), key=lambda task: task.get_name())
        places = [f"\n  {task.get_name()} at {_place(task.get_coro())}" for task in tasks]
        return f"{len(places)} tasks wait for ever{''.join(places)}"

    def call_soon_threadsafe(
        self, callback: Callable[[*_Arguments], object], *args: *_Arguments, context: Context | None = None
    ) -> asyncio.Handle:
        if self._thread_id not in (None, threading.get_ident()):
            self.refuse()
        return self.call_soon(callback, *args, context=context)

    def run_in_executor(
        self, _executor: object, func: Callable[[*_Arguments], _Result], *args: *_Arguments
    ) -> asyncio.Future[_Result]:
        """Run the function in the loop. As in a thread, it finds no running loop."""
        future: asyncio.Future[_Result] = self.create_future()
        self.call_soon(self._run_inline, future, func, args)
        return future

    def _run_inline(
        self, future: asyncio.Future[_Result], func: Callable[..., _Result], args: tuple[Any, ...]
    ) -> None:
        if future.cancelled():
            return
        asyncio._set_running_loop(None)
        try:
            result = func(*args)
        except Exception as error:  # noqa: BLE001  the caller gets it, as from a thread
            future.set_exception(error)
        else:
            future.set_result(result)
        finally:
            asyncio._set_running_loop(self)

    def refuse(self, *_args: object, **_options: object) -> Never:
        raise RealLoopError(
            "this test uses a socket, a signal, a program or a thread, which a loop with virtual time does not have:"
            " replace it, or mark the test `real` or `nightly`"
        )

    async def refuse_to_wait(self, *_args: object, **_options: object) -> Never:
        self.refuse()

    if not TYPE_CHECKING:  # the signatures are many, and nothing is done with the arguments
        add_signal_handler = refuse
        create_datagram_endpoint = connect_read_pipe = connect_write_pipe = refuse_to_wait
        subprocess_exec = subprocess_shell = refuse_to_wait


class AutojumpLoop(_JumpingLoop):
    def __init__(self, machine: VirtualClock, most_jumps: int = _MAX_JUMPS) -> None:
        super().__init__()
        self.machine, self._most_jumps = machine, most_jumps
        self._selector = self  # `BaseEventLoop` selects when it has run what was ready

    def select(self, timeout: float | None) -> list[Never]:
        self._jump(timeout)
        return []

    def _process_events(self, _events: list[Never]) -> None: ...

    def remove_reader(self, _fd: object) -> bool:
        return False

    remove_writer = remove_signal_handler = remove_reader  # type: ignore[assignment]  # parameters' names differ

    if not TYPE_CHECKING:
        add_reader = add_writer = _JumpingLoop.refuse
        sock_accept = sock_connect = sock_recv = sock_recv_into = sock_recvfrom = _JumpingLoop.refuse_to_wait
        sock_sendall = sock_sendfile = sock_sendto = _JumpingLoop.refuse_to_wait
        create_connection = create_server = connect_accepted_socket = _JumpingLoop.refuse_to_wait
        create_unix_connection = create_unix_server = _JumpingLoop.refuse_to_wait


class LocalLoop(_JumpingLoop, asyncio.SelectorEventLoop):
    """A loop for local sockets: time passes when no socket is ready. It is made inside `local_sockets`."""

    def __init__(self, machine: VirtualClock, most_jumps: int = _MAX_JUMPS) -> None:
        self.machine, self._most_jumps = machine, most_jumps
        super().__init__(_JumpingSelector(self._jump))


class _JumpingSelector(selectors.EpollSelector):
    def __init__(self, jump: Callable[[float | None], None]) -> None:
        super().__init__()
        self._jump = jump

    def select(self, timeout: float | None = None) -> list[tuple[selectors.SelectorKey, int]]:
        ready = super().select(0)
        if not ready and timeout != 0:
            self._jump(timeout)
        return ready


def _place(coroutine: Any) -> str:
    while isinstance(coroutine, CoroutineType) and isinstance(coroutine.cr_await, CoroutineType):
        coroutine = coroutine.cr_await
    frame = getattr(coroutine, "cr_frame", None)
    return (
        f"{frame.f_code.co_filename}:{frame.f_lineno} {frame.f_code.co_qualname}"
        if frame
        else repr(coroutine)
    )


@contextlib.contextmanager
def autojump(
    machine: VirtualClock | None = None,
    *,
    most_jumps: int = _MAX_JUMPS,
    kind: type[AutojumpLoop | LocalLoop] = AutojumpLoop,
) -> Iterator[Callable[[], AutojumpLoop | LocalLoop]]:
    """Yield a factory of loops. `machine` becomes the clock of the block; the default is the test's own."""
    present = clock.source()
    machine = machine or (present if isinstance(present, VirtualClock) else VirtualClock())
    with clock.using(machine):
        yield lambda: kind(machine, most_jumps)


def run(main: Coroutine[Any, Any, _Result], *, most_jumps: int = _MAX_JUMPS) -> _Result:
    with autojump(most_jumps=most_jumps) as new_loop, asyncio.Runner(loop_factory=new_loop) as runner:
        return runner.run(main)


def own_tasks() -> set["asyncio.Task[Any]"]:
    """Return the tasks of the running loop, without those in which anyio runs a test and its fixtures."""
    tasks = asyncio.all_tasks()
    return {task for task in tasks if "TestRunner" not in getattr(task.get_coro(), "__qualname__", "")}


@pytest.fixture
def anyio_backend(request: pytest.FixtureRequest) -> Iterator[tuple[str, dict[str, Any]]]:
    if may_depend_on_chance(request.node):
        yield "asyncio", {}
    else:
        local = not {"sockets", "local_sockets"}.isdisjoint(request.fixturenames)
        with autojump(kind=LocalLoop if local else AutojumpLoop) as new_loop:
            yield "asyncio", {"loop_factory": new_loop}
