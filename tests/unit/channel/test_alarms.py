import ast
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest

from appliance.channel import alarms
from appliance.channel.alarms import ALARM_KINDS, activity, open_alarms
from appliance.channel.answers.status import Status
from tests.support.answers import example

GOOD: dict[str, Any] = {
    "probe": "passed",
    "relay": "connected",
    "rosmaster": "reachable",
    "policy": {"revision": 3, "file": "robot.ini"},
    "monitors": {"revision": 1},
}


def changed(path: str, value: object, **more: object) -> Status:
    section, _dot, field = path.partition(".")
    said = {section: GOOD.get(section, {}) | {field: value}} if field else {section: value}
    return example(Status, **{**GOOD, **said, **more})


def test_a_healthy_appliance_has_none() -> None:
    assert open_alarms(example(Status, **GOOD)) == []
    assert open_alarms(changed("probe", "")) == []


@pytest.mark.parametrize(
    ("path", "value", "kind", "severity", "about"),
    [
        ("probe", "11312 answers", "probe", "alarm", "system"), ("relay", "away", "relay", "alarm", "system"),
        ("rosmaster", "being rebuilt", "rosmaster", "warning", "system"),
        ("audit.failed", "disk full", "audit-failed", "alarm", "audit"),
        ("relay", "1 of 2 are away", "relay", "alarm", "system"),
        ("firewall.hold_lapsed", "the robot did not wait", "hold-lapsed", "alarm", "system"),
        ("firewall.removed", "nft removed 2 rules of the firewall", "rules-removed", "alarm", "system"),
        ("audit.replaced", "log a was replaced", "audit-replaced", "alarm", "audit"),
        ("audit.degraded", "fsync is slow", "audit-degraded", "warning", "audit"),
        ("policy.confirm_by", 1.0, "policy-unconfirmed", "warning", "policy"),
        ("policy.audit_only", ["Publishers"], "policy-audit-only", "warning", "policy"),
        ("policy.differs_from_file", True, "policy-differs", "notice", "policy"),
        ("policy.file_refused", "p.ini:1:1: error", "policy-refused", "alarm", "policy"),
        ("monitors.held", ["safeTrigger"], "monitor-held:safeTrigger", "alarm", "monitors"),
        ("monitors.failing", ["logging"], "monitor-failing:logging", "alarm", "monitors"),
        ("monitors.refused", ["a.rv:1:1: no"], "monitors-refused", "alarm", "monitors"),
        ("monitors.left_out", {"a.rv": "a.rv:1:1: no"}, "monitor-left-out:a.rv", "alarm", "monitors"),
        ("monitors.folder_refused", "a.rv:1:1: no", "monitors-folder-refused", "alarm", "monitors"),
        ("monitors.differs_from_folder", True, "monitors-differ", "notice", "monitors"),
        ("ipsec.troubles", ["a certificate ends"], "ipsec", "warning", "hosts"),
        (
            "tokens_ending",
            [{"name": "alice", "role": "admin", "expires": 1.0}],
            "token-ends:alice",
            "warning",
            "system",
        ),
        ("blocks.hosts", 1, "hosts-blocked", "notice", "hosts"),
        (
            "processes",
            [{"role": "charon", "failing": "no /dev/net/tun"}],
            "process-failing:charon",
            "alarm",
            "system",
        ),
    ],
)  # fmt: skip
def test_each_condition_is_an_alarm(path: str, value: object, kind: str, severity: str, about: str) -> None:
    (alarm,) = open_alarms(changed(path, value))
    assert (alarm.kind, alarm.severity, alarm.about) == (kind, severity, about)
    assert len(alarm.text) > 5


@pytest.mark.parametrize(
    ("path", "value", "commands"),
    [
        ("policy.differs_from_file", True, ["rosrv policy reload; ", "rosrv policy show > "]),
        ("monitors.differs_from_folder", True, ["rosrv monitor reload; ", "rosrv monitor reload --prune"]),
    ],
)
def test_a_notice_of_two_texts_has_the_commands_that_choose_one(
    path: str, value: object, commands: list[str]
) -> None:
    (alarm,) = open_alarms(changed(path, value))
    assert [command for command in commands if command not in alarm.text] == []


@pytest.mark.parametrize("cause", ["the disk", "the load", "signer"])
def test_the_remedy_of_a_degraded_log_has_each_cause(cause: str) -> None:
    assert cause in ALARM_KINDS["audit-degraded"].remedy


def test_alarms_that_are_present_together_have_different_names() -> None:
    """An operator handles an alarm by its name, and so never a later one of another process or host."""
    failing = [{"role": role, "failing": "it ends"} for role in ("relay", "relay", "hook", "door", "door")]
    ipsec = {"troubles": ["a certificate ends", "open ports"], "trouble_names": ["a:certificate", "a:ports"]}
    found = open_alarms(changed("monitors.refused", ["a.rv: no", "b.rv: no"], processes=failing, ipsec=ipsec))
    assert sorted(alarm.kind for alarm in found) == [
        "ipsec:a:certificate", "ipsec:a:ports", "monitors-refused", "process-failing:door-0",
        "process-failing:door-1", "process-failing:hook", "process-failing:relay-0", "process-failing:relay-1",
    ]  # fmt: skip
    assert "a.rv: no; b.rv: no" in next(alarm.text for alarm in found if alarm.kind == "monitors-refused")
    repeated = ast.For | ast.While | ast.ListComp | ast.SetComp | ast.GeneratorExp
    for path, tree in sources_of_conditions():
        for loop in (node for node in ast.walk(tree) if isinstance(node, repeated)):
            for kind in kinds_in(loop, path):
                assert not isinstance(kind, ast.Constant), f"{path.name}:{kind.lineno}: add what it is about"


PACKAGE = Path(alarms.__file__).parents[1]


def kinds_in_the_source() -> Iterator[str]:
    """Yield the kind of each condition that some code makes: of each `Trouble`, and here of each tuple."""
    for path, tree in sources_of_conditions():
        for first in kinds_in(tree, path):
            yield from _kind(first)


def sources_of_conditions() -> Iterator[tuple[Path, ast.AST]]:
    for path in PACKAGE.rglob("*.py"):
        text = path.read_text(encoding="utf-8")
        if "Trouble(" in text or path.name == "alarms.py":
            yield path, ast.parse(text)


def kinds_in(tree: ast.AST, path: Path) -> Iterator[ast.expr]:
    for node in ast.walk(tree):
        match node:
            case ast.Call(func=ast.Name("Trouble" | "_alarm"), args=[first, *_]):
                yield first
            case ast.Yield(ast.Tuple([first, _, _])) if path.name == "alarms.py":
                yield first


def _kind(first: ast.expr) -> Iterator[str]:
    match first:
        case ast.JoinedStr([ast.Constant(str() as text), *_]) | ast.Constant(str() as text):
            yield text.partition(":")[0]
        case ast.JoinedStr([ast.FormattedValue(ast.Name(name)), *_]):
            yield str(getattr(alarms, name)).partition(":")[0]


def test_each_kind_has_its_row_which_says_who_needs_a_person_now() -> None:
    assert set(kinds_in_the_source()) | {"ipsec"} == set(ALARM_KINDS)
    page = (PACKAGE.parent / "docs/reference/generated/alarms.md").read_text(encoding="utf-8")
    for name, kind in ALARM_KINDS.items():
        assert f"| `{name}` | {kind.severity} | {kind.remedy} |" in page


STARTING: dict[str, Any] = {"starting": True, "relay": "away", "rosmaster": "being rebuilt"}


def test_the_first_seconds_of_a_start_fail_nothing() -> None:
    assert [alarm.kind for alarm in open_alarms(example(Status, **GOOD | STARTING))] == ["starting"]
    assert open_alarms(example(Status, **GOOD | {"starting": True})) == []
    lasting = open_alarms(example(Status, **GOOD | STARTING | {"starting": False}))
    assert [alarm.kind for alarm in lasting] == ["relay", "rosmaster"]


def test_one_missing_relay_is_not_reported_as_all() -> None:
    (alarm,) = open_alarms(changed("relay", "1 of 2 are away"))
    assert "1 of 2 are away: their topics" in alarm.text


@pytest.mark.parametrize(
    ("hosts", "end", "text"),
    [
        (1, None, "1 host is blocked, without an end: rosrv host blocks"),
        (1, 0.0, "1 host is blocked, the block ends at 1970-01-01T00:00:00+00:00: rosrv host blocks"),
        (3, 0.0, "3 hosts are blocked, the first block ends at 1970-01-01T00:00:00+00:00: rosrv host blocks"),
    ],
)
def test_blocks_are_one_line_with_count_and_earliest_end(hosts: int, end: float | None, text: str) -> None:
    [alarm] = open_alarms(example(Status, **GOOD, blocks={"hosts": hosts, "first_end": end}))
    assert alarm.text == text


def test_the_gravest_come_first() -> None:
    status = changed("policy.differs_from_file", True, relay="away", rosmaster="being rebuilt")
    assert [alarm.severity for alarm in open_alarms(status)] == ["alarm", "warning", "notice"]


def test_drops_and_many_denials_of_the_last_minute_are_warnings() -> None:
    recent = {"denials": 9, "drops": {"zone": 2, "limit": 1}, "attention_at": 10}
    status = example(Status, **GOOD, last_minute=recent)
    drops = [
        "limit dropped 1 message in the last minute; rosrv audit search --event 'message dropped' --since 1m",
        "zone dropped 2 messages in the last minute; rosrv audit search --event 'message dropped' --since 1m",
    ]
    assert [(alarm.severity, alarm.text, alarm.about) for alarm in activity(status)] == [
        ("warning", text, "monitors") for text in drops
    ]
    many = activity(example(Status, **GOOD, last_minute=recent | {"denials": 10}))
    assert (many[0].kind, many[0].about) == ("denials", "audit")
    assert [alarm.text for alarm in many] == [
        "10 denials in the last minute; rosrv audit summary --since 1m",
        *drops,
    ]
    assert open_alarms(status) == []
