from pathlib import Path

import pytest

from appliance.supervisor import priority
from appliance.supervisor.priority import (
    SAMPLE_SECONDS,
    PrioritizedProcess,
    ProcessorPressure,
    keep_priorities,
    may_raise_priority,
    waited_seconds,
)
from tests.support.autojump import run

PSI = "some avg10=0.18 avg60=0.95 avg300=1.24 total={}\nfull avg10=0.00 avg60=0.00 avg300=0.00 total=7\n"


def judged(pressure: ProcessorPressure, *samples: tuple[float, float]) -> list[bool]:
    """Return whether the machine is busy after each sample: its time, and the share of it in which some task waited."""
    now = waited = 0.0
    answers = []
    for seconds, share in samples:
        now, waited = now + seconds, waited + seconds * share
        answers.append(pressure.is_busy(waited, now))
    return answers


def test_a_machine_is_busy_until_two_seconds_pass_without_load() -> None:
    quiet, busy = (0.1, 0.05), (0.1, 0.9)
    answers = judged(ProcessorPressure(), quiet, *[quiet] * 25, busy, *[quiet] * 25)
    assert answers[0] and not answers[25], "it is busy until it is known to be quiet"
    assert answers[26:46] == [True] * 20 and not answers[47]


@pytest.mark.parametrize(("share", "busy"), [(0.19, False), (0.21, True)])
def test_a_fifth_of_a_sample_is_busy_however_long_it_took(share: float, busy: bool) -> None:
    """The loop of the supervisor is late when the machine is busy."""
    answers = judged(ProcessorPressure(), (0.1, 0.0), (3.0, 0.0), (0.1, share), (7.0, share))
    assert answers == [True, False, busy, busy]


def test_a_kernel_that_does_not_say_is_busy() -> None:
    pressure = ProcessorPressure()
    judged(pressure, (0.1, 0.0), (3.0, 0.0))
    assert pressure.is_busy(None, 4.0) and pressure.is_busy(4.0, 4.1)


@pytest.mark.parametrize(
    ("text", "expected"), [(PSI.format(16_564_749_325), 16564.749325), ("", None), ("some avg10=0.1\n", None)]
)
def test_the_waiting_of_the_kernel(tmp_path: Path, text: str, expected: float | None) -> None:
    (tmp_path / "cpu").write_text(text)
    assert waited_seconds(tmp_path / "cpu") == expected
    assert waited_seconds(tmp_path / "none") is None


@pytest.mark.parametrize(
    ("status", "may"),
    [("CapEff:\t0000000000800000\n", True), ("CapEff:\t000001ffff7fffff\n", False), ("Name:\tx\n", False)],
)
def test_only_who_can_give_priority_back_takes_it(tmp_path: Path, status: str, may: bool) -> None:
    (tmp_path / "status").write_text(status)
    assert may_raise_priority(tmp_path / "status") is may
    assert not may_raise_priority(tmp_path / "none")


def test_processes_follow_the_load(monkeypatch: pytest.MonkeyPatch) -> None:
    """A process starts with its priority. One that has just ended disturbs none of the others."""
    shares = iter([*[0.0] * 25, *[1.0] * 5, *[0.0] * 25])
    waited, pids, changes = [0.0], [7, 8], []

    def waits() -> float:
        waited[0] += SAMPLE_SECONDS * next(shares)
        return waited[0]

    def set_niceness(pid: int, nice: int) -> None:
        changes.append((pid, nice))
        if pid == 8:
            raise FileNotFoundError

    monkeypatch.setattr(priority, "waited_seconds", waits)
    monkeypatch.setattr(priority, "may_raise_priority", lambda: True)
    monkeypatch.setattr(priority, "set_niceness", set_niceness)
    with pytest.raises(RuntimeError, match="StopIteration"):
        run(keep_priorities(lambda: [PrioritizedProcess(pid, -10, 0) for pid in pids]))
    assert changes == [(7, 0), (8, 0), (7, -10), (8, -10), (7, 0), (8, 0)]


def test_without_the_permission_a_process_keeps_its_priority(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(priority, "may_raise_priority", lambda: False)
    run(keep_priorities(list))
