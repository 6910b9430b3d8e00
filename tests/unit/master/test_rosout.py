import msgspec
import pytest

from appliance.channel.messages import MonitorEvent, OwnPublished
from appliance.master.rosout import Rosout, header
from roswire.message_view import read_fields
from roswire.standard import standard_definitions

DEFINITIONS = standard_definitions()
LINE = MonitorEvent("log", "gate", "key", "/chatter", 1_700_000_000_250_000_000, "ünsafe", {"level": "WARN"})


class Desk:
    def __init__(self) -> None:
        self.now = 10.0
        self.sent: list[OwnPublished] = []
        self.rosout = Rosout("/rosrv", self.sent.append, lambda monitor: f"{monitor}.rv", lambda: self.now)

    def said(self) -> list[dict[str, object]]:
        fields = [read_fields(DEFINITIONS, "rosgraph_msgs/Log", one.data) for one in self.sent]
        return [field for field in fields if field is not None]


def test_a_line_is_a_log_message() -> None:
    desk = Desk()
    desk.rosout.reported(LINE)
    (said,) = desk.said()
    assert desk.sent[0].topic == "/rosout"
    assert {name: said[name] for name in ("level", "name", "msg", "file", "function", "topics")} == {
        "level": 4, "name": "/rosrv", "msg": "ünsafe", "file": "gate.rv", "function": "gate", "topics": [],
    }  # fmt: skip
    assert said["header"]["stamp"] == 1_700_000_000.25  # type: ignore[index]  # a message is read as nested dicts


@pytest.mark.parametrize(
    ("kind", "detail", "level"),
    [
        ("log", {"level": "DEBUG"}, None),
        ("log", {"level": "FATAL"}, 16),
        ("verdict", {"category": "violation"}, 4),
        ("verdict", {"category": "match"}, 2),
        ("fault", {}, 8),
        ("drop", {}, None),
        ("change", {}, None),
        ("publish", {}, None),
    ],
)
def test_reports_have_the_level_of_their_kind(kind: str, detail: dict[str, str], level: int | None) -> None:
    desk = Desk()
    desk.rosout.reported(msgspec.structs.replace(LINE, kind=kind, detail=detail))
    assert [one["level"] for one in desk.said()] == ([] if level is None else [level])


def test_a_flood_is_cut_and_reported() -> None:
    desk = Desk()
    for _ in range(60):
        desk.rosout.reported(LINE)
    desk.rosout.reported(msgspec.structs.replace(LINE, count=5))
    assert len(desk.sent) == 50
    desk.now += 1
    desk.rosout.reported(msgspec.structs.replace(LINE, count=3))
    assert [one["msg"] for one in desk.said()[50:]] == [
        "15 more lines of monitors; the audit log has them",
        "3 more in the same second: ünsafe",
    ]
    assert [one["level"] for one in desk.said()[50:]] == [4, 4]


def test_the_header_is_that_of_ros() -> None:
    assert header(DEFINITIONS).md5sum == "acffd30cd6b6de30f120938c17c593fb"
