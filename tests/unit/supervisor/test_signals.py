"""Signals that arrive during operations that must be completed.

Each test runs a separate process, because a signal to a thread of the test runner would end the runner.
"""

import subprocess
import sys

import pytest

pytestmark = pytest.mark.nightly

_BEGIN = """
import os, signal, threading
from appliance.supervisor import signals

ENDING = (signal.SIGTERM, signal.SIGINT, signal.SIGHUP)

def send():
    for number in ENDING:
        os.kill(os.getpid(), number)
"""
_HELD = """
arrived = []
for number in ENDING:
    signal.signal(number, lambda found, _frame: arrived.append(found))
with signals.hold():
    send()
    assert arrived == []
    with signals.hear():
        assert sorted(arrived) == sorted(ENDING)
    send()
assert len(arrived) == len(ENDING)
assert not signal.pthread_sigmask(signal.SIG_BLOCK, ()) & set(ENDING)
send()
assert len(arrived) == 2 * len(ENDING)
"""
_THREAD = """
blocked, done = threading.Event(), threading.Event()

def work():
    signals.block()
    blocked.set()
    assert done.wait(30)

thread = threading.Thread(target=work)
thread.start()
assert blocked.wait(30)
with signals.hold():
    send()  # would end this process
    assert set(ENDING) <= signal.sigpending()
done.set()
thread.join()
"""


def by_itself(script: str) -> None:
    done = subprocess.run(
        [sys.executable, "-c", _BEGIN + script], capture_output=True, text=True, check=False, timeout=120
    )
    assert done.returncode == 0, done.stderr


def test_held_signals_arrive_when_a_handler_is_set() -> None:
    by_itself(_HELD)


def test_a_thread_does_not_take_them() -> None:
    by_itself(_THREAD)
