from collections.abc import Iterator
from types import SimpleNamespace
from typing import Any, cast

import pytest

from appliance.base.clock import using
from appliance.cli.connection.admin_client import NotRunningError
from appliance.cli.connection.target import Appliance
from appliance.features.selftest import live_checks as selftest_running
from tests.support.virtual_clock import VirtualClock

OURS = SimpleNamespace(
    sequence=7, record=SimpleNamespace(caller_id="/rosrv_selftest_00c0ffee", id="0192-ours", host="10.0.0.1")
)
NOT_OURS = SimpleNamespace(sequence=6, record=SimpleNamespace(caller_id="/joy", id="0192-other"))


class Log:
    def __init__(self) -> None:
        self.answers: list[Any] = []
        self.searches = 0
        self.machine = VirtualClock()

    @property
    def way(self) -> "Log":
        return self

    def last(self) -> int:
        return 5

    def search(self, *_arguments: object, newest_first: bool) -> Any:
        assert newest_first
        self.searches += 1
        self.machine.advance(0.001)  # a search takes time
        answer = self.answers.pop(0) if len(self.answers) > 1 else self.answers[0]
        if isinstance(answer, Exception):
            raise answer
        return SimpleNamespace(entries=answer)


@pytest.fixture
def log(monkeypatch: pytest.MonkeyPatch) -> Iterator[Log]:
    log = Log()
    monkeypatch.setattr(selftest_running, "time", SimpleNamespace(sleep=log.machine.advance))
    monkeypatch.setattr(selftest_running, "secrets", SimpleNamespace(token_hex=lambda _bytes: "00c0ffee"))
    monkeypatch.setattr(selftest_running, "call", lambda *_arguments: None)
    monkeypatch.setattr(selftest_running, "audit_of", lambda way: way)
    with using(log.machine):
        yield log


def outcome(log: Log) -> tuple[str, str]:
    (found,) = selftest_running.check_call(cast(Appliance, log), "http://127.0.0.1:11311")
    return found.outcome, found.text


def test_a_delayed_record_is_found(log: Log) -> None:
    log.answers = [[NOT_OURS], [NOT_OURS], [OURS, NOT_OURS]]
    found, text = outcome(log)
    assert found == "ok"
    assert "and recorded" in text
    assert log.searches == 3


@pytest.mark.nightly
def test_a_missing_record_is_searched_for_five_seconds(log: Log) -> None:
    log.answers = [[NOT_OURS]]
    found, text = outcome(log)
    assert found == "fail"
    assert "is not in the audit log" in text
    assert log.searches <= 15


def test_a_refused_search_is_repeated(log: Log) -> None:
    log.answers = [NotRunningError("https://h: too many requests"), [OURS]]
    assert outcome(log)[0] == "ok"


@pytest.mark.nightly
def test_an_unreadable_log_is_not_a_defect(log: Log) -> None:
    log.answers = [NotRunningError("https://h: too many requests")]
    found, text = outcome(log)
    assert found == "skip"
    assert "too many requests" in text
