import secrets
import time
from collections.abc import Iterator
from contextlib import nullcontext
from itertools import chain, islice, repeat
from types import SimpleNamespace
from typing import NoReturn

import httpx
import pytest

from appliance.audit.log.record import AuditRecord
from appliance.audit.log.record_format import LogEntry, as_json
from appliance.base import clock
from appliance.channel.answers.status import Status
from appliance.cli.connection.admin_client import AccessDeniedError, NotRunningError
from appliance.cli.connection.audit_over_rest import RestLog
from appliance.features.selftest import live_checks
from roswire.tcpros import encode_frame, encode_header
from tests.support.answers import example
from tests.support.memory_call import call_of
from tests.support.memory_rest import page, problem, rest_client
from tests.support.virtual_clock import VirtualClock, let_time_pass


def record(sequence: int, caller_id: str) -> str:
    made = AuditRecord(id=f"{sequence:020x}", time=1, event="decision", host="10.0.0.1", caller_id=caller_id)
    return as_json(LogEntry(sequence, made))


FIRST, NOT_OURS, OURS = record(5, "/joy"), record(6, "/joy"), record(7, "/rosrv_selftest_00c0ffee")
DENIED: list[str] = []
"""Stands for an answer that refuses a search."""


@pytest.fixture(autouse=True)
def call_and_time(monkeypatch: pytest.MonkeyPatch) -> Iterator[None]:
    monkeypatch.setattr(time, "sleep", let_time_pass)
    monkeypatch.setattr(secrets, "token_hex", lambda _bytes: "00c0ffee")
    monkeypatch.setattr(live_checks, "call", lambda *_arguments: None)
    with clock.using(VirtualClock()):
        yield


def outcome(*searches: list[str]) -> tuple[str, str, int]:
    """Check a call whose record is searched for with these answers, the last one again and again.

    Return the outcome, its text, and the number of searches.
    """
    answers, number = chain(searches, repeat(searches[-1])), 0

    def answer(request: httpx.Request) -> httpx.Response:
        nonlocal number
        if "order" not in request.url.params:
            return page([FIRST])  # the last one before the call
        number += 1
        let_time_pass(0.001)  # a search takes time
        records = next(answers)
        return problem(429, "busy", "too many requests") if records is DENIED else page(records)

    [finding] = live_checks.check_call(RestLog(rest_client(answer)), "http://127.0.0.1:11311")
    return finding.outcome, finding.text, number


def test_a_delayed_record_is_found() -> None:
    found, text, searches = outcome([NOT_OURS, FIRST], [NOT_OURS, FIRST], [OURS, NOT_OURS, FIRST])
    assert (found, searches) == ("ok", 3)
    assert "and recorded" in text


def test_a_missing_record_is_searched_for_five_seconds() -> None:
    began = clock.now()
    found, text, searches = outcome([NOT_OURS, FIRST])
    assert found == "fail"
    assert "is not in the audit log" in text
    assert searches <= 15 and 5 < clock.now() - began < 7


def test_a_refused_search_is_repeated() -> None:
    assert outcome(DENIED, [OURS])[0] == "ok"


def test_an_unreadable_log_is_not_a_defect() -> None:
    found, text, _searches = outcome(DENIED)
    assert found == "skip"
    assert "too many requests" in text


@pytest.mark.parametrize(("error", "advice"), [(AccessDeniedError("use sudo"), "sudo rosrv selftest"),
                                               (NotRunningError("away"), "start it (rosrv up)")])  # fmt: skip
def test_a_user_without_access_is_not_told_to_start_it(error: Exception, advice: str) -> None:
    def answer(_request: object) -> NoReturn:
        raise error

    [found] = live_checks.running(call_of(answer))
    assert (found.outcome, found.advice.partition(",")[0]) == ("fail", advice)


OFF = {"about": "monitors", "name": "gun", "what": "monitor gun is disabled", "again": "rosrv monitor enable gun",
       "since": 0.0, "until": None, "forgotten": False}  # fmt: skip


def test_protection_that_is_off_is_a_warning_and_no_failure() -> None:
    healthy = {"probe": "passed", "relay": "connected", "rosmaster": "reachable"}
    guards = {"loaded": 1, "acting": [], "never_enabled": {"deadman": "off"}}
    status = example(Status, **healthy, switched_off=[OFF], guards=guards)
    found = islice(live_checks.running(call_of(lambda _request: status)), 1, 4)
    told = {(one.outcome, one.text.rpartition(": ")[2]) for one in found}
    commands = {"rosrv monitor enable gun", "rosrv monitor enable deadman"}
    assert told >= {("warn", command) for command in commands}
    assert not any(outcome == "fail" for outcome, _command in told)


MESSAGE = encode_header({"type": "std_msgs/String"}) + encode_frame(b"selftest")
WAYS: dict[str, tuple[str, bytes | None, str]] = {
    "a message": ("", MESSAGE, "ok"),
    "another message": ("", MESSAGE.replace(b"selftest", b"changed!"), "fail"),
    "the publisher is denied": ("registerPublisher", MESSAGE, "skip"),
    "the subscriber is denied": ("registerSubscriber", MESSAGE, "skip"),
    "the relay's place is refused": ("requestTopic", MESSAGE, "fail"),
    "no publisher": ("no publisher", MESSAGE, "fail"),
    "an error in the header": ("", encode_header({"error": "too many connections"}), "fail"),
    "closed": ("", b"", "fail"),
    "silent": ("", None, "fail"),
}
"""By what happens: the call of the master that is refused, and the bytes that the relay sends."""


class Relay:
    """A connection to a relay that sends these bytes and closes it; None: it sends nothing."""

    def __init__(self, sent: bytes | None) -> None:
        self._sent = sent

    def __enter__(self) -> "Relay":
        return self

    def __exit__(self, *_error: object) -> None: ...

    def sendall(self, _header: bytes) -> None: ...

    def recv(self, _size: int) -> bytes:
        if self._sent is None:
            raise TimeoutError("timed out")
        sent, self._sent = self._sent, b""
        return sent


@pytest.mark.parametrize("way", WAYS)
def test_only_a_denied_message_is_skipped(monkeypatch: pytest.MonkeyPatch, way: str) -> None:
    refused, sent, expected = WAYS[way]

    def call(_uri: str, method: str, *_arguments: object) -> object:
        if method == refused:
            raise live_checks.ProbeError("refused")
        places = [] if refused == "no publisher" else ["http://127.0.0.1:1/"]
        return {"registerSubscriber": places, "requestTopic": ["TCPROS", "127.0.0.1", 2]}.get(method, 0)

    monkeypatch.setattr(live_checks, "call", call)
    monkeypatch.setattr(live_checks, "own_address", lambda _master: "127.0.0.1")
    monkeypatch.setattr(live_checks, "_node", lambda _host: nullcontext(SimpleNamespace(uri="")))
    monkeypatch.setattr(live_checks, "socket", SimpleNamespace(create_connection=lambda *_place: Relay(sent)))
    [found] = live_checks._message("http://127.0.0.1:11311")
    assert found.outcome == expected, found.text
