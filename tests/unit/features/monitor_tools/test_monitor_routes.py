from appliance.features.monitor_tools.routes import records_of
from tests.support.audit import decision, settle
from tests.unit.audit.conftest import MakeLog, key, make_log, notary, path

__all__ = ["key", "make_log", "notary", "path"]


def test_a_viewer_learns_nothing_of_monitor_names_inside_messages(make_log: MakeLog) -> None:
    log = make_log()
    for number in range(600):
        detail = {"monitor": "m" if number % 300 else "gun", "before_fields": {"data": "gun password"}}
        log.record(decision(log, event="message dropped", category="monitor", detail=detail))
    settle(log)
    assert records_of(log.path, "password", None, 2) == []
    assert [entry.record.detail["monitor"] for entry in records_of(log.path, "gun", None, 5)] == ["gun"] * 2
    [last] = records_of(log.path, "gun", None, 1)
    [first] = records_of(log.path, "gun", str(last.sequence), 5)
    assert first.sequence < last.sequence
    assert len(records_of(log.path, "m", None, 51)) == 51
