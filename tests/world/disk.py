"""Run the store and the audit log without threads, on files that a killed process leaves as the kernel would.

A kill comes between two turns of an engine. As after `kill -9`, the files then have everything that was written, even
if it was not synced, because the machine keeps its power.
"""

import os
import sqlite3
from types import SimpleNamespace
from typing import Any

from appliance.base import clock
from appliance.base.engine_thread import Turn
from appliance.store.writer_thread import Database
from tests.world.loop import Process, present_process

_SOON = (0.0, 0.5, 1.0)  # of the time for gathering work
_LEAST_SECONDS = 0.0005


class EngineSteps:
    def __init__(self, name: str, turn: Turn, gather: float) -> None:
        self._at_once = name == "store"  # which makes `Database.query` wait, and so the whole process
        self._turn = turn
        self._gather = max(gather, _LEAST_SECONDS)
        self._process = present_process()
        self._wanted = False
        self._due: float | None = None
        self._number = 0  # of the timer for the next turn that is due
        self._step()

    def wake(self) -> None:
        if not self._wanted:
            self._wanted = True
            loop = self._process.machine.loop
            self._process.call(self._gather * loop.random.choice(_SOON), self._step)

    def hurry(self) -> None:
        if self._at_once:
            self._step()
        else:
            self.wake()

    def end(self, _seconds: float | None) -> bool:
        while self._due is not None:
            self._step()
        return True

    def _step(self) -> None:
        self._wanted = False
        now = clock.now()
        self._due = self._turn(now)
        while self._due is not None and self._due <= now:
            self._due = self._turn(now)
        self._number += 1
        if self._due is not None and self._due < float("inf"):
            self._process.call(self._due - now, self._timer, self._number)

    def _timer(self, number: int) -> None:
        if number == self._number:
            self._step()


class WorldDatabase(Database):
    def __init__(self, *given: Any, **named: Any) -> None:
        super().__init__(*given, **named, drive=EngineSteps)


def files() -> tuple[Any, Any]:
    def opened(*given: Any, **named: Any) -> int:
        descriptor = os.open(*given, **named)
        process = owners[descriptor] = present_process()
        process.ends.append(lambda: closed(descriptor) if owners.get(descriptor) is process else None)
        return descriptor

    def closed(descriptor: int) -> None:
        owners.pop(descriptor, None)
        os.close(descriptor)

    def connected(*given: Any, **named: Any) -> sqlite3.Connection:
        connection: sqlite3.Connection = sqlite3.connect(*given, **named)
        present_process().ends.append(connection.close)
        return connection

    owners: dict[int, Process] = {}
    return (
        SimpleNamespace(**{**vars(os), "open": opened, "close": closed}),
        SimpleNamespace(**{**vars(sqlite3), "connect": connected}),
    )
