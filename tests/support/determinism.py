"""Forbid a test everything whose result depends on chance: threads, processes, sockets, pauses and real clocks.

An audit hook of Python sees processes and sockets, even in libraries. The rest has no hook in Python 3.11, so
functions are replaced. Only our own code's reads of a clock count.
"""

import functools
import inspect
import itertools
import sys
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from multiprocessing.process import BaseProcess
from typing import Any

import pytest

from tests.support.local_sockets import LocalSocket

_FORBIDDEN = {
    "os.exec": "starts a program",
    "os.fork": "starts a process",
    "os.forkpty": "starts a process",
    "os.posix_spawn": "starts a process",
    "os.system": "starts a process",
    "subprocess.Popen": "starts a process",
    "socket.__new__": "makes a socket",
}
_CLOCKS = ("clock_gettime", "clock_gettime_ns", "monotonic", "monotonic_ns", "time", "time_ns")
_OURS = ("appliance", "rosmop", "roswire", "rosrv_fleet", "fleet", "tests", "lab.")


class ChanceError(RuntimeError):
    pass


class Watch:
    """Records and forbids such events while a test is watched. There is one, as an audit hook cannot be removed."""

    def __init__(self) -> None:
        self._watched = False
        self._found: list[str] = []

    def install(self) -> None:
        sys.addaudithook(self._event)
        for owner, name, what in (
            (threading.Thread, "start", "starts a thread"),
            (BaseProcess, "start", "starts a process"),
            (time, "sleep", "sleeps"),
        ):
            setattr(owner, name, self._forbidding(what, getattr(owner, name)))
        for name in _CLOCKS:
            setattr(time, name, self._clock(name, getattr(time, name)))
        self._times = {name: value for name, value in vars(time).items() if callable(value)}

    def restore_times(self) -> list[str]:
        """Restore the functions of `time`, and return the names of those that a test has replaced."""
        replaced = [name for name, value in self._times.items() if vars(time).get(name) is not value]
        vars(time).update({name: self._times[name] for name in replaced})
        return replaced

    @contextmanager
    def watching(self) -> Iterator[list[str]]:
        found: list[str] = []
        outer = self._found, self._watched
        self._found, self._watched = found, True
        try:
            yield found
        finally:
            self._found, self._watched = outer

    def _event(self, event: str, arguments: tuple[Any, ...]) -> None:
        if self._watched and event in _FORBIDDEN and not _is_harmless(event, arguments):
            self._refuse(_FORBIDDEN[event])

    def _forbidding(self, what: str, act: Callable[..., Any]) -> Callable[..., Any]:
        @functools.wraps(act)
        def acting(*arguments: Any) -> Any:
            if self._watched:
                self._refuse(what)
            return act(*arguments)

        return acting

    def _clock(self, name: str, read: Callable[..., Any]) -> Callable[..., Any]:
        def reading(*arguments: Any) -> Any:
            if self._watched and next(callers(1), "").startswith(_OURS):
                self._refuse(f"reads time.{name}")
            return read(*arguments)

        return reading

    def _refuse(self, what: str) -> None:
        ours = (name for name in callers(2) if name.startswith(_OURS) and name != __name__)
        found = f"{what} in {next(ours, 'a library')}"
        self._found.append(found)
        raise ChanceError(f"this test {found}; only tests marked `real` or `nightly` may")


WATCH = Watch()


def may_depend_on_chance(item: pytest.Item) -> bool:
    return any(item.get_closest_marker(name) for name in ("real", "nightly"))


def callers(depth: int) -> Iterator[str]:
    frame = inspect.currentframe()
    while frame is not None:
        if depth < 0:
            yield str(frame.f_globals.get("__name__", ""))
        depth, frame = depth - 1, frame.f_back


def _is_harmless(event: str, arguments: tuple[Any, ...]) -> bool:
    """Allow local sockets, those with which threads wake a loop, and the one with which urllib3 tests for IPv6."""
    if event == "socket.__new__" and isinstance(arguments[0], LocalSocket):
        return True
    makers = {"asyncio.selector_events", "urllib3.util.connection"}
    return event == "socket.__new__" and not makers.isdisjoint(itertools.islice(callers(2), 5))
