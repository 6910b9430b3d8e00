import json

import httpx
import pytest

from appliance.audit.log.record import AuditRecord
from appliance.audit.log.record_format import LogEntry, as_object
from appliance.audit.search.query import Filter, FilterError
from appliance.cli.connection import audit_over_rest as audit_rest
from appliance.cli.connection.admin_client import NotRunningError
from appliance.cli.connection.audit_over_rest import RestLog
from tests.support.memory_rest import page, problem, rest_client, stream

END = 'data: {"reason": "the token has expired"}'


def log_of(*streams: httpx.Response | httpx.HTTPError) -> RestLog:
    """Return the log of an appliance with these answers to exports and streams, and without present records."""
    left = iter(streams)

    def answer(request: httpx.Request) -> httpx.Response:
        response = page([]) if request.url.path == "/v1/audit" else next(left)
        if isinstance(response, httpx.HTTPError):
            raise response
        return response

    return RestLog(rest_client(answer))


def line(sequence: int) -> str:
    return json.dumps(
        as_object(LogEntry(sequence, AuditRecord(id=f"{sequence:020x}", time=1, event="decision")))
    )


@pytest.mark.parametrize(
    ("refusal", "told"),
    [
        ((422, "bad-input", "resource: too many stars"), FilterError),
        ((503, "log-unreadable", "audit.db: damaged"), NotRunningError),
        ((500, "defect", "a defect"), NotRunningError),
    ],
)
def test_refused_streams_raise_the_errors_of_a_file(
    refusal: tuple[int, str, str], told: type[Exception], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(audit_rest, "_AGAIN_SECONDS", 0.0)
    with pytest.raises(told, match=refusal[2]):
        list(log_of(problem(*refusal)).export(Filter()))
    log = log_of(*(problem(*refusal) for _ in range(5)))
    with pytest.raises(told, match=refusal[2]):
        list(log.follow(Filter(), 0, on=True))


@pytest.mark.parametrize("text", ["{", "[]", '{"sequence": 1}', '"text"', "7"])
def test_invalid_lines_are_an_error_of_the_server(text: str) -> None:
    with pytest.raises(NotRunningError, match="is not an appliance's REST API"):
        list(log_of(stream([text])).export(Filter()))


def test_an_export_gives_its_records() -> None:
    found = list(log_of(stream([line(1), "", line(2)])).export(Filter()))
    assert [one.sequence for one in found] == [1, 2]


def test_following_survives_broken_connections(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(audit_rest, "_AGAIN_SECONDS", 0.0)
    broken = [stream([": ping"], breaks=True) for _ in range(20)]
    last = stream(["event: record", f"data: {line(9)}", "event: end", END])
    followed = log_of(*broken, last).follow(Filter(), 0, on=True)
    assert [one.sequence for one in next(followed)] == [9]
    with pytest.raises(NotRunningError, match="the token has expired"):
        next(followed)


def test_following_ends_without_a_server(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(audit_rest, "_AGAIN_SECONDS", 0.0)
    away = [httpx.ConnectError("no route to the host")] * 5
    with pytest.raises(NotRunningError, match="cannot be reached: no route to the host"):
        list(log_of(stream([], breaks=True), *away).follow(Filter(), 0, on=True))


@pytest.mark.parametrize(
    "record_id", ["XYZ", "18E9AA02EFC40ABB0E51", "a" * 21, "verify", "stream", "", "../x", "é"]
)
def test_an_invalid_id_matches_no_record(record_id: str) -> None:
    assert log_of().show(record_id, 500) is None


def test_a_snapshot_over_rest_has_the_events_in_the_order_of_the_log() -> None:
    """Each event is a request, one after the other: a server limits how many a token has at the same time."""
    log = log_of(*(stream([line(number) for number in numbers]) for numbers in ((3, 9), (5,))))
    assert [entry.sequence for entry in log.snapshot().of_events(("policy loaded", "monitor set"))] == [
        3,
        5,
        9,
    ]


def test_a_snapshot_over_rest_reads_pages_only_as_they_are_wanted() -> None:
    asked: list[str] = []

    def answer(request: httpx.Request) -> httpx.Response:
        cursor = request.url.params["cursor"]
        asked.append(cursor)
        return page([line(int(cursor) + 1)], str(int(cursor) + 1))

    following = RestLog(rest_client(answer)).snapshot().following("rest call", 7)
    assert [next(following).sequence for _ in range(2)] == [8, 9]
    assert len(asked) < 100
