"""Tests of `appliance.cli.audit.log_over_rest`: the log over REST fails, and goes on, as it does from its file."""

import json
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any, cast

import pytest

from appliance.audit.query import Filter, FilterError
from appliance.audit.record import Record
from appliance.audit.record_format import Entry, as_object
from appliance.cli.admin_client import NotRunningError
from appliance.cli.audit import log_over_rest as audit_rest
from appliance.cli.audit.log_over_rest import RestLog
from appliance.cli.rest.session import ProblemError, RestClient

END = 'data: {"reason": "the token has ended"}'


class Answer:
    """An answer of so many lines, after which its connection breaks, unless it ends."""

    def __init__(self, lines: list[str], *, breaks: bool) -> None:
        self._lines = lines
        self._breaks = breaks

    def iter_lines(self) -> Iterator[str]:
        """Its lines."""
        yield from self._lines
        if self._breaks:
            raise NotRunningError("the connection broke")


class Rest:
    """REST that gives these answers to streams, one after the other; an empty log to the rest."""

    url = "https://robot"

    def __init__(self, *answers: Answer | Exception) -> None:
        self.answers = list(answers)

    def call(self, _method: str, path: str, **_more: Any) -> dict[str, Any]:
        """A page without records."""
        assert path == "/v1/audit"
        return {"records": [], "cursor": None}

    @contextmanager
    def streamed(self, _method: str, _path: str, **_more: Any) -> Iterator[Answer]:
        """The next answer."""
        answer = self.answers.pop(0)
        if isinstance(answer, Exception):
            raise answer
        yield answer


def log_of(*answers: Answer | Exception) -> RestLog:
    """The log of such a REST."""
    return RestLog(cast(RestClient, Rest(*answers)))


def line(sequence: int) -> str:
    """A record as REST writes it."""
    return json.dumps(as_object(Entry(sequence, Record(id=f"{sequence:020x}", time=1, event="decision"))))


@pytest.mark.parametrize(
    ("refusal", "told"),
    [
        (ProblemError(422, "bad-input", ["resource: too many stars"]), FilterError),
        (ProblemError(503, "log-unreadable", ["audit.db: damaged"]), NotRunningError),
        (ProblemError(500, "defect", ["a defect"]), NotRunningError),
    ],
)
def test_refusals_of_what_is_streamed(
    refusal: ProblemError, told: type[Exception], monkeypatch: pytest.MonkeyPatch
) -> None:
    """An export and a stream that REST refuses are told as the log's file would tell it."""
    monkeypatch.setattr(audit_rest, "_AGAIN_SECONDS", 0.0)
    with pytest.raises(told, match=refusal.lines[0]):
        list(log_of(refusal).export(Filter()))
    log = log_of(*[refusal] * 5)
    with pytest.raises(told, match=refusal.lines[0]):
        list(log.follow(Filter(), 0, on=True))


@pytest.mark.parametrize("text", ["{", "[]", '{"sequence": 1}', '"text"', "7"])
def test_lines_that_are_no_records(text: str) -> None:
    """A server that is no appliance is told so, and is no defect of ours."""
    with pytest.raises(NotRunningError, match="is not the REST of an appliance"):
        list(log_of(Answer([text], breaks=False)).export(Filter()))


def test_an_export_gives_its_records() -> None:
    """Every line is a record, in order."""
    found = list(log_of(Answer([line(1), "", line(2)], breaks=False)).export(Filter()))
    assert [one.sequence for one in found] == [1, 2]


def test_following_survives_any_number_of_broken_connections(monkeypatch: pytest.MonkeyPatch) -> None:
    """A stream that opened and broke is no failure in a row, also when no record came through it."""
    monkeypatch.setattr(audit_rest, "_AGAIN_SECONDS", 0.0)
    broken = [Answer([": ping"], breaks=True) for _ in range(20)]
    last = Answer(["event: record", f"data: {line(9)}", "event: end", END], breaks=False)
    followed = log_of(*broken, last).follow(Filter(), 0, on=True)
    assert [one.sequence for one in next(followed)] == [9]
    with pytest.raises(NotRunningError, match="the token has ended"):
        next(followed)


def test_following_gives_up_when_nobody_answers(monkeypatch: pytest.MonkeyPatch) -> None:
    """Five times in a row that no stream opens are an end."""
    monkeypatch.setattr(audit_rest, "_AGAIN_SECONDS", 0.0)
    rest: list[Answer | Exception] = [Answer([], breaks=True)]
    rest += [NotRunningError("cannot be reached")] * 5
    with pytest.raises(NotRunningError, match="cannot be reached"):
        list(log_of(*rest).follow(Filter(), 0, on=True))


@pytest.mark.parametrize(
    "record_id", ["XYZ", "18E9AA02EFC40ABB0E51", "a" * 21, "verify", "stream", "", "../x", "é"]
)
def test_what_is_no_id_is_no_record(record_id: str) -> None:
    """As where the log's file is read: there is no such record, and REST is not asked."""
    assert log_of().show(record_id, 500) is None
