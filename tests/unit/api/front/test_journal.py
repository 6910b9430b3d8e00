from typing import Any

import msgspec

from appliance.api.front.journal import Journal
from appliance.channel.messages.api import RestCalled


def answered(journal: Journal, **changes: Any) -> None:
    fields: dict[str, Any] = {
        "host": "h", "who": "w", "method": "GET", "path": "/p", "status": 200, "reason": "", "duration_us": 7,
    }  # fmt: skip
    journal.answered(**fields | changes)


def test_equal_reads_are_reported_once_and_counted() -> None:
    told: list[RestCalled] = []
    journal = Journal(told.append)
    for _ in range(4):
        answered(journal)
    answered(journal, path="/q")
    assert [(one.path, one.count, one.duration_us) for one in told] == [("/p", 1, 7), ("/q", 1, 7)]
    journal.flush()
    assert [(one.path, one.count) for one in told[2:]] == [("/p", 3)]
    answered(journal)
    assert told[-1].count == 1


def test_changes_are_never_folded() -> None:
    told: list[RestCalled] = []
    journal = Journal(told.append)
    for _ in range(3):
        answered(journal, method="POST")
    assert len(told) == 3
    for _ in range(3):
        answered(journal, method="POST", who="", status=401)
    assert len(told) == 4


def test_a_flood_of_kinds_is_bounded_and_hides_no_other_host() -> None:
    told: list[RestCalled] = []
    journal = Journal(told.append, kinds=10)
    for number in range(1000):
        answered(journal, who="", path=f"/{number}", status=401)
    answered(journal, host="other", path="/q")
    assert len(told) == 9
    journal.flush()
    assert [one.path for one in told if one.host == "other"] == ["/q"]
    assert sum(one.count for one in told if one.host == "h") == 1000
    assert len(told) == 10


def test_unknown_methods_share_one_label() -> None:
    journal = Journal(lambda call: None)
    for number in range(50):
        answered(journal, method=f"M{number}", status=405)
    answered(journal)
    assert journal.calls == {("other", "405"): 50, ("GET", "200"): 1}


def test_invalid_text_is_escaped() -> None:
    told: list[RestCalled] = []
    journal = Journal(told.append)
    answered(journal, reason="names: \ud800 é", path="/\udcff", method="POST")
    assert (told[0].reason, told[0].path) == ("names: \\ud800 é", "/\\udcff")
    assert msgspec.msgpack.encode(told[0])
