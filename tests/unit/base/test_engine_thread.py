import math
import queue
import threading

import pytest

from appliance.base.engine_thread import EngineThread

pytestmark = pytest.mark.nightly

_LIMIT = 60


class Engine:
    def __init__(self, *dues: float) -> None:
        self.turns: queue.Queue[float] = queue.Queue()
        self.closed = False
        self._dues = list(dues)  # seconds from a turn to the next one

    def turn(self, now: float) -> float | None:
        self.turns.put(now)
        if self.closed:
            return None
        return now + self._dues.pop(0) if self._dues else math.inf

    def end(self, thread: EngineThread) -> bool:
        self.closed = True
        return thread.end(_LIMIT)


def test_the_first_turn_is_over_when_the_thread_is_made() -> None:
    engine = Engine()
    thread = EngineThread("engine", engine.turn, 0.0)
    assert engine.turns.qsize() == 1
    assert engine.end(thread)
    assert engine.turns.qsize() == 2


def test_turns_are_called_when_they_are_due() -> None:
    engine = Engine(0.0, 0.05)
    thread = EngineThread("engine", engine.turn, 0.0)
    times = [engine.turns.get(timeout=_LIMIT) for _ in range(3)]
    assert times[2] - times[1] >= 0.05
    assert engine.end(thread)


def test_new_work_is_gathered_until_a_caller_waits() -> None:
    engine = Engine()
    thread = EngineThread("engine", engine.turn, 600.0)
    engine.turns.get(timeout=_LIMIT)
    thread.wake()
    with pytest.raises(queue.Empty):
        engine.turns.get(timeout=0.05)
    thread.hurry()
    engine.turns.get(timeout=_LIMIT)
    assert engine.end(thread)

    gathering = EngineThread("engine", (later := Engine()).turn, 0.05)
    began = later.turns.get(timeout=_LIMIT)
    gathering.wake()
    assert later.turns.get(timeout=_LIMIT) - began >= 0.05
    assert later.end(gathering)


def test_the_end_of_a_turn_that_lasts_is_not_awaited_for_long() -> None:
    working = threading.Event()

    def turn(_now: float) -> float | None:
        if not working.is_set():
            working.set()
            return math.inf
        released.wait(_LIMIT)
        return None

    released = threading.Event()
    thread = EngineThread("engine", turn, 0.0)
    assert not thread.end(0.01)
    released.set()
    assert thread.end(_LIMIT)


def test_a_defect_ends_the_thread(monkeypatch: pytest.MonkeyPatch) -> None:
    printed: list[threading.ExceptHookArgs] = []
    monkeypatch.setattr(threading, "excepthook", printed.append)

    def turn(_now: float) -> float:
        raise RuntimeError("unforeseen")

    assert EngineThread("engine", turn, 0.0).end(_LIMIT)
    assert [str(one.exc_value) for one in printed] == ["unforeseen"]
