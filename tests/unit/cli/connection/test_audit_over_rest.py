import json
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any, cast

import pytest

from appliance.audit.log.record import AuditRecord
from appliance.audit.log.record_format import LogEntry, as_object
from appliance.audit.search.query import Filter, FilterError
from appliance.cli.connection import audit_over_rest as audit_rest
from appliance.cli.connection.admin_client import NotRunningError, RestProblemError
from appliance.cli.connection.audit_over_rest import RestLog
from appliance.cli.connection.rest_session import RestClient

END = 'data: {"reason": "the token has expired"}'


class Answer:
    def __init__(self, lines: list[str], *, breaks: bool) -> None:
        self._lines = lines
        self._breaks = breaks

    def iter_lines(self) -> Iterator[str]:
        yield from self._lines
        if self._breaks:
            raise NotRunningError("the connection broke")


class Rest:
    url = "https://robot"

    def __init__(self, *answers: Answer | Exception) -> None:
        self.answers = list(answers)

    def call(self, _method: str, path: str, **_more: Any) -> dict[str, Any]:
        assert path == "/v1/audit"
        return {"records": [], "cursor": None}

    @contextmanager
    def streamed(self, _method: str, _path: str, **_more: Any) -> Iterator[Answer]:
        answer = self.answers.pop(0)
        if isinstance(answer, Exception):
            raise answer
        yield answer


def log_of(*answers: Answer | Exception) -> RestLog:
    return RestLog(cast(RestClient, Rest(*answers)))


def line(sequence: int) -> str:
    return json.dumps(
        as_object(LogEntry(sequence, AuditRecord(id=f"{sequence:020x}", time=1, event="decision")))
    )


@pytest.mark.parametrize(
    ("refusal", "told"),
    [
        (RestProblemError(422, "bad-input", ["resource: too many stars"]), FilterError),
        (RestProblemError(503, "log-unreadable", ["audit.db: damaged"]), NotRunningError),
        (RestProblemError(500, "defect", ["a defect"]), NotRunningError),
    ],
)
def test_refused_streams_raise_the_errors_of_a_file(
    refusal: RestProblemError, told: type[Exception], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(audit_rest, "_AGAIN_SECONDS", 0.0)
    with pytest.raises(told, match=refusal.lines[0]):
        list(log_of(refusal).export(Filter()))
    log = log_of(*[refusal] * 5)
    with pytest.raises(told, match=refusal.lines[0]):
        list(log.follow(Filter(), 0, on=True))


@pytest.mark.parametrize("text", ["{", "[]", '{"sequence": 1}', '"text"', "7"])
def test_invalid_lines_are_an_error_of_the_server(text: str) -> None:
    with pytest.raises(NotRunningError, match="is not an appliance's REST API"):
        list(log_of(Answer([text], breaks=False)).export(Filter()))


def test_an_export_gives_its_records() -> None:
    found = list(log_of(Answer([line(1), "", line(2)], breaks=False)).export(Filter()))
    assert [one.sequence for one in found] == [1, 2]


def test_following_survives_broken_connections(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(audit_rest, "_AGAIN_SECONDS", 0.0)
    broken = [Answer([": ping"], breaks=True) for _ in range(20)]
    last = Answer(["event: record", f"data: {line(9)}", "event: end", END], breaks=False)
    followed = log_of(*broken, last).follow(Filter(), 0, on=True)
    assert [one.sequence for one in next(followed)] == [9]
    with pytest.raises(NotRunningError, match="the token has expired"):
        next(followed)


def test_following_ends_without_a_server(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(audit_rest, "_AGAIN_SECONDS", 0.0)
    rest: list[Answer | Exception] = [Answer([], breaks=True)]
    rest += [NotRunningError("cannot be reached")] * 5
    with pytest.raises(NotRunningError, match="cannot be reached"):
        list(log_of(*rest).follow(Filter(), 0, on=True))


@pytest.mark.parametrize(
    "record_id", ["XYZ", "18E9AA02EFC40ABB0E51", "a" * 21, "verify", "stream", "", "../x", "é"]
)
def test_an_invalid_id_matches_no_record(record_id: str) -> None:
    assert log_of().show(record_id, 500) is None


def test_a_snapshot_over_rest_has_the_events_in_the_order_of_the_log() -> None:
    """Each event is a request, one after the other: a server limits how many a token has at the same time."""
    log = log_of(*(Answer([line(number) for number in numbers], breaks=False) for numbers in ((3, 9), (5,))))
    assert [entry.sequence for entry in log.snapshot().of_events(("policy loaded", "monitor set"))] == [
        3,
        5,
        9,
    ]


def test_a_snapshot_over_rest_reads_pages_only_as_they_are_wanted() -> None:
    asked: list[str] = []

    class Pages(Rest):
        def call(self, _method: str, path: str, **more: Any) -> dict[str, Any]:
            cursor = more["params"]["cursor"]
            asked.append(cursor)
            return {"records": [json.loads(line(int(cursor) + 1))], "cursor": str(int(cursor) + 1)}

    following = RestLog(cast(RestClient, Pages())).snapshot().following("rest call", 7)
    assert [next(following).sequence for _ in range(2)] == [8, 9]
    assert len(asked) < 100
