"""Tests of how `rosrv selftest` looks for its own call in the audit log, with a clock that a test moves."""

from collections.abc import Iterator
from types import SimpleNamespace
from typing import Any, cast

import pytest

from appliance.cli.admin_client import NotRunningError
from appliance.cli.selftest import live_checks as selftest_running
from appliance.cli.target import Appliance

OURS = SimpleNamespace(
    sequence=7, record=SimpleNamespace(caller_id="/rosrv_selftest_00c0ffee", id="0192-ours", host="10.0.0.1")
)
NOT_OURS = SimpleNamespace(sequence=6, record=SimpleNamespace(caller_id="/joy", id="0192-other"))


class Log:
    """An audit log that answers one search after the other with what a test says."""

    def __init__(self) -> None:
        self.answers: list[Any] = []
        self.searches = 0

    def audit(self) -> "Log":
        """Where an appliance has it."""
        return self

    def last(self) -> int:
        """Before the call."""
        return 5

    def search(self, *_arguments: object, newest_first: bool) -> Any:
        """The next answer; the last one again and again."""
        assert newest_first
        self.searches += 1
        answer = self.answers.pop(0) if len(self.answers) > 1 else self.answers[0]
        if isinstance(answer, Exception):
            raise answer
        return SimpleNamespace(entries=answer)


@pytest.fixture
def log(monkeypatch: pytest.MonkeyPatch) -> Iterator[Log]:
    """A log; every second that is waited passes at once."""
    now = [100.0]

    def sleep(seconds: float) -> None:
        assert seconds > 0
        now[0] += seconds

    def monotonic() -> float:
        now[0] += 0.001  # a search takes a moment
        return now[0]

    monkeypatch.setattr(selftest_running, "time", SimpleNamespace(monotonic=monotonic, sleep=sleep))
    monkeypatch.setattr(selftest_running, "secrets", SimpleNamespace(token_hex=lambda _bytes: "00c0ffee"))
    monkeypatch.setattr(selftest_running, "call", lambda *_arguments: None)
    yield Log()


def outcome(log: Log) -> tuple[str, str]:
    """What the check of RVMaster says."""
    (found,) = selftest_running.check_call(cast(Appliance, log), "http://127.0.0.1:11311")
    return found.outcome, found.text


def test_a_call_that_is_recorded_a_moment_later_is_found(log: Log) -> None:
    """The log is written in batches: it is looked at again."""
    log.answers = [[NOT_OURS], [NOT_OURS], [OURS, NOT_OURS]]
    found, text = outcome(log)
    assert found == "ok"
    assert "and recorded" in text
    assert log.searches == 3


def test_a_call_that_is_not_recorded_is_looked_for_a_few_times_only(log: Log) -> None:
    """Five seconds: over REST each look is a request, and many at once are refused (429)."""
    log.answers = [[NOT_OURS]]
    found, text = outcome(log)
    assert found == "fail"
    assert "is not in the audit log" in text
    assert log.searches <= 15


def test_a_look_that_is_refused_is_made_again(log: Log) -> None:
    """Too many requests, a process that is started again: it passes."""
    log.answers = [NotRunningError("https://h: too many requests"), [OURS]]
    assert outcome(log)[0] == "ok"


def test_a_log_that_cannot_be_seen_is_no_defect(log: Log) -> None:
    """Whether the call was recorded is not known then, and why is told."""
    log.answers = [NotRunningError("https://h: too many requests")]
    found, text = outcome(log)
    assert found == "skip"
    assert "too many requests" in text
