"""Run work on segments and evidence in separate processes, with a lower priority than the server.

The work may take minutes of processor time, in which it would hold the server's interpreter lock. Workers are not a
sandbox: they run as the server's user, and the server unpickles their results.
"""

import multiprocessing
import os
import resource
import signal
import threading
from collections.abc import Callable, Iterator
from concurrent.futures import Future, ProcessPoolExecutor
from concurrent.futures.process import BrokenProcessPool
from contextlib import contextmanager
from pathlib import Path
from typing import ParamSpec, TypeVar

P = ParamSpec("P")
T = TypeVar("T")
_NICE = 5
_END_SECONDS = 10.0


class OutOfTimeError(BaseException):
    """The work took more processor time than its limit.

    It is not an `Exception`, because the work may catch all exceptions and continue.
    """


class Workers:
    """At most `count` processes, started on demand. Thread-safe."""

    def __init__(self, count: int) -> None:
        self._count = count
        self._lock = threading.Lock()
        self._pool: ProcessPoolExecutor | None = None

    def submit(self, work: Callable[P, T], *arguments: P.args, **named: P.kwargs) -> Future[T]:
        """Run the work in a worker. The future raises `BrokenProcessPool` if that was killed."""
        with self._lock:
            try:
                return self._present().submit(work, *arguments, **named)
            except BrokenProcessPool:
                self._pool = None
                return self._present().submit(work, *arguments, **named)

    def _present(self) -> ProcessPoolExecutor:
        if self._pool is None:
            context = multiprocessing.get_context("forkserver")  # this process has threads: it must not fork
            context.set_forkserver_preload(["rosrv_fleet.cli"])
            self._pool = ProcessPoolExecutor(self._count, context, initializer=_begin)
        return self._pool

    def close(self) -> None:
        """Kill the workers and wait for their end. Unfinished work is lost."""
        with self._lock:
            if self._pool is not None:
                self._pool.shutdown(wait=False, cancel_futures=True)
                children = multiprocessing.active_children()
                for child in children:
                    child.kill()
                for child in children:
                    child.join(_END_SECONDS)


def _begin() -> None:
    os.nice(_NICE)
    signal.signal(
        signal.SIGINT, signal.SIG_IGN
    )  # a terminal sends it to all processes; the server ends its workers
    threading.Thread(target=_end_with_server, daemon=True).start()


def _end_with_server() -> None:
    server = multiprocessing.parent_process()
    if server is not None:
        server.join()
    os._exit(1)


@contextmanager
def processor_time(seconds: float) -> Iterator[None]:
    """Raise `OutOfTimeError` when the block has used `seconds` of processor time. Only in a worker."""

    def late(_signal: int, _frame: object) -> None:
        raise OutOfTimeError(f"it took more than {seconds:g} s of processor time")

    signal.signal(signal.SIGPROF, late)
    # It is repeated, because a callback from compiled code may lose an exception.
    signal.setitimer(signal.ITIMER_PROF, seconds, 1.0)
    try:
        yield
    finally:
        signal.setitimer(signal.ITIMER_PROF, 0)


@contextmanager
def memory(most: int) -> Iterator[None]:
    """Raise `MemoryError` when the block needs more than `most` additional bytes. Only in a worker."""
    soft, hard = resource.getrlimit(resource.RLIMIT_AS)
    used = int(Path("/proc/self/statm").read_text().split()[0]) * resource.getpagesize()
    limits = [used + most, *(limit for limit in (soft, hard) if limit != resource.RLIM_INFINITY)]
    resource.setrlimit(resource.RLIMIT_AS, (min(limits), hard))
    try:
        yield
    finally:
        resource.setrlimit(resource.RLIMIT_AS, (soft, hard))
