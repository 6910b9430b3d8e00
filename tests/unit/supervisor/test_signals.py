"""Tests of `appliance.supervisor.signals`: what is sent while nothing may be left half done."""

import os
import signal
import threading

from appliance.supervisor import signals

ENDING = (signal.SIGTERM, signal.SIGINT, signal.SIGHUP)


def send() -> None:
    """Each of them, to this process."""
    for number in ENDING:
        os.kill(os.getpid(), number)


def test_what_is_sent_while_they_are_held_is_heard_when_somebody_listens() -> None:
    """Nothing happens at first, then each arrives; what comes later is forgotten, and all is as before."""
    arrived: list[int] = []
    before = {number: signal.signal(number, lambda found, _frame: arrived.append(found)) for number in ENDING}
    try:
        with signals.held():
            send()
            assert arrived == []
            with signals.heard():
                assert sorted(arrived) == sorted(ENDING)
            send()
        assert len(arrived) == len(ENDING)
        assert signal.pthread_sigmask(signal.SIG_BLOCK, ()) & set(ENDING) == set()
        send()
        assert len(arrived) == 2 * len(ENDING)
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)


def test_a_thread_does_not_take_them() -> None:
    """The kernel gives a signal to any thread that takes it: one that blocks them leaves it to wait."""
    blocked, done = threading.Event(), threading.Event()

    def work() -> None:
        signals.block()
        blocked.set()
        assert done.wait(30)

    thread = threading.Thread(target=work)
    thread.start()
    assert blocked.wait(30)
    with signals.held():
        send()  # would end this process
        assert set(ENDING) <= signal.sigpending()
    done.set()
    thread.join()
