from typing import Any

from msgspec import structs

from appliance.audit.log.record import AuditRecord
from appliance.audit.log.record_format import LogEntry
from appliance.audit.log.repetition import HOST, KIND, new_state, summary
from appliance.audit.search.query import Filter
from appliance.features.topics.verbs import PastPublishers, publishers_at


def entry(sequence: int, event: str, **fields: Any) -> LogEntry:
    return LogEntry(sequence, AuditRecord(id=str(sequence), time=sequence * 10**9, event=event, **fields))


def unknown(log: list[LogEntry], at: int) -> tuple[str, ...]:
    return found(log, at).unknown


def found(log: list[LogEntry], at: int) -> PastPublishers:
    def export(wanted: Filter) -> list[LogEntry]:
        return [one for one in log if one.record.event == wanted.event]

    return publishers_at(export, log[0] if log else None, "/a", at * 10**9)


def test_gaps_of_the_log_are_reported() -> None:
    begun = entry(1, "log begun")
    assert unknown([begun, entry(2, "appliance started")], 5) == ()
    [removed] = unknown([entry(4, "decision")], 5)
    assert removed.startswith("records before 1970-01-01T00:00:04.000000000Z were removed")
    [earlier] = unknown([entry(1, "log begun", detail={"earlier_log_missing": True})], 5)
    assert earlier.startswith("an earlier log is missing")
    [lost] = unknown([begun, entry(3, "records lost")], 5)
    assert lost.startswith("records were lost")
    [empty] = unknown([], 5)
    assert empty.startswith("the log is empty")


def test_a_time_without_the_appliance_is_reported() -> None:
    log = [entry(1, "log begun"), entry(2, "appliance started")]
    stopped, again = entry(4, "appliance stopped"), entry(8, "appliance started")
    [orderly] = unknown([*log, stopped, again], 5)
    assert orderly.startswith("the appliance was stopped at 1970-01-01T00:00:04")
    assert unknown([*log, stopped, again], 3) == ()
    assert unknown([*log, stopped, again], 9) == ()
    [cut] = unknown([*log, again], 5)
    assert cut.startswith("the appliance ended without a record before its start at 1970-01-01T00:00:08")
    assert unknown([*log, again], 1) == (), "between the log's begin and the first start"
    assert len(unknown([entry(4, "decision"), again], 5)) == 2, "retention has removed the earlier start"


def counted(sequence: int, scope: str, event: str, **fields: Any) -> LogEntry:
    first = entry(sequence - 2, event, host="10.0.0.9", caller_id="/n", **fields).record
    state = new_state(structs.replace(first, folds=True), scope)
    state.count_in(first)
    return LogEntry(sequence, summary(state, str(sequence), sequence * 10**9))


def test_registrations_that_were_only_counted_are_reported() -> None:
    topic = {"category": "publication", "resource": "/a"}
    log = [
        entry(1, "log begun"),
        entry(2, "registered", host="10.0.0.9", caller_id="/n", **topic),
        entry(3, "unregistered", host="10.0.0.9", caller_id="/n", **topic),
    ]
    for summed in (
        counted(6, KIND, "registered", **topic),
        counted(6, HOST, "registered", category="publication", resource="/b"),
        counted(6, KIND, "node returned", category=None, resource=None),
    ):
        assert [line[:13] for line in unknown([*log, summed], 5)] == ["registrations"]
        assert unknown([*log, summed], 3) == (), "it was counted later"
    for other in (
        counted(6, KIND, "registered", category="publication", resource="/b"),
        counted(6, KIND, "registered", category="subscription", resource="/a"),
        counted(6, KIND, "decision", **topic),
    ):
        assert unknown([*log, other], 5) == ()


def test_the_end_of_a_registration_shows_its_beginning_only_without_a_loss() -> None:
    """A node that unregistered was registered before the log begins, unless records were lost in between."""
    end = entry(8, "unregistered", host="10.0.0.9", caller_id="/n", category="publication", resource="/a")
    log = [entry(1, "decision"), counted(7, KIND, "decision"), end]
    assert [publisher.node for publisher in found(log, 5).publishers] == ["/n"]
    assert found([entry(1, "decision"), entry(7, "records lost"), end], 5).publishers == ()
