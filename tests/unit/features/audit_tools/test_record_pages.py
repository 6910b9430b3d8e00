import pytest

from appliance.audit.search.query import Filter
from appliance.features.audit_tools.routes import page_of
from tests.support.audit import decision, settle
from tests.unit.api.front.test_streams import bearer
from tests.unit.audit.conftest import MakeLog, key, make_log, notary, path

__all__ = ["key", "make_log", "notary", "path"]


@pytest.mark.nightly
def test_a_viewers_page_reveals_nothing_that_is_withheld(make_log: MakeLog) -> None:
    log = make_log()
    said = {"monitor": "m", "before_fields": {"data": "password"}}
    for number in range(40):
        hidden = number % 4 != 3
        log.record(decision(log, reason="x" if hidden else "the password", detail=said if hidden else {}))
    settle(log)
    for newest in (True, False):
        for limit in (1, 2, 3, 10, 100):
            found: list[int] = []
            cursor, first = None, True
            while first or cursor is not None:
                page = page_of(
                    log.path, Filter(text="password"), cursor, limit, bearer("v"), newest_first=newest
                )
                cursor, first = page["cursor"], False
                assert len(page["records"]) == limit or cursor is None
                found += [record["sequence"] for record in page["records"]]
            assert sorted(found, reverse=newest) == found == [*dict.fromkeys(found)]
            assert len(found) == 10
    empty: dict[str, object] = {"records": [], "cursor": None}
    hidden_only = Filter(text="data")
    assert page_of(log.path, hidden_only, None, 1, bearer("v"), newest_first=True) == empty
    reader = bearer("o", "operator")
    assert len(page_of(log.path, hidden_only, None, 1, reader, newest_first=True)["records"]) == 1


def test_equality_is_of_the_parts_that_the_client_may_read(make_log: MakeLog) -> None:
    log = make_log()
    for text in ("the password is 1", "the password is 2"):
        detail = {"monitor": "m", "before_fields": {"data": text}, "why": text}
        log.record(
            decision(log, event="message dropped", category="monitor", reason="dropped", detail=detail)
        )
    settle(log)
    wanted = Filter(event="message dropped")
    plain = page_of(log.path, wanted, None, 9, bearer("v"), newest_first=True)
    assert "equality" not in plain
    for reader in (bearer("v"), bearer("o", "operator")):
        page = page_of(log.path, wanted, None, 9, reader, newest_first=True, equality=True)
        first, second = page["equality"]
        assert first | {"began": second["began"], "ended": second["ended"]} == second
        assert (first["times"], first["value"]) == (1, "dropped")
    assert page_of(log.path, wanted, None, 1, bearer("v"), newest_first=True, equality=True)["equality"] == [
        first
    ]


def test_a_search_for_messages_says_that_they_are_never_recorded(make_log: MakeLog) -> None:
    """The note names only this version, because an older one may have recorded messages."""
    log = make_log()
    settle(log)
    slips = Filter(event="message droped", category="publsh")
    page = page_of(log.path, slips, None, 1, bearer("v"), newest_first=True)
    assert page["notes"] == [
        "this version records no event 'message droped'; did you mean message dropped?",
        "this version records no category 'publsh'; did you mean publish?",
    ]
    for known in (Filter(event="message dropped", category="publish"), Filter(event="droped*")):
        assert "notes" not in page_of(log.path, known, None, 1, bearer("v"), newest_first=True)
