from collections.abc import Collection
from typing import Any

import msgspec
import pytest

from appliance.specifications.checking import check
from appliance.specifications.live_topics import LiveType, judge_holds, judge_topics
from appliance.specifications.specification_files import (
    CheckedSpecifications,
    Sources,
)

TEXT = """\
a() {
    event said() /chatter std_msgs/String '{}' { std_msgs::String report; PUBLISH(/alarm, std_msgs/String, report); }
}
"""
CODE = check(Sources({"a.rv": TEXT}), ())
LIVE: dict[str, dict[str, LiveType]] = {"/chatter": {"/talker": LiveType("std_msgs/String")}}


def judged(
    live: dict[str, dict[str, LiveType]], *, shadow: Collection[str] = (), forced: bool = False
) -> tuple[list[str], list[str]]:
    findings = judge_topics(CODE, CheckedSpecifications(), live, shadow=shadow, forced=forced)
    return findings.conflicts, findings.warnings


def test_a_fitting_type_is_not_a_finding() -> None:
    assert judged(LIVE) == ([], [])
    assert judged({"/chatter": {"/talker": LiveType("*")}}) == ([], [])


def test_a_topic_that_monitors_publish_has_one_type() -> None:
    live = LIVE | {"/alarm": {"/siren": LiveType("std_msgs/Bool")}}
    conflicts, warnings = judged(live)
    assert warnings == []
    (conflict,) = conflicts
    assert conflict.startswith("a.rv:2:")
    assert (
        "/siren publishes /alarm as std_msgs/Bool, not as std_msgs/String: subscribers would get" in conflict
    )
    conflicts, warnings = judged(live, forced=True)
    assert (conflicts, len(warnings)) == ([], 1)
    assert judged(live, shadow=("a",))[0] == []


@pytest.mark.parametrize(
    ("live", "hint"),
    [({"/chater": {"/t": LiveType("std_msgs/String")}}, "; did you mean /chater?"), ({}, "")],
)
def test_a_topic_without_a_publisher_is_a_warning(live: dict[str, dict[str, LiveType]], hint: str) -> None:
    assert judged(live) == ([], [f"a.rv:2:5: warning: no node publishes /chatter now{hint}"])


STRING, OTHER = "992ce8a1687cec8c8bd883ec73ca41d1", "0" * 32


@pytest.mark.parametrize("theirs", [STRING, "*", ""])
def test_a_definition_that_fits_or_is_not_known(theirs: str) -> None:
    assert judged({"/chatter": {"/talker": LiveType("std_msgs/String", theirs)}}) == ([], [])


def test_a_type_of_the_same_name_with_another_definition() -> None:
    live = {"/chatter": {"/talker": LiveType("std_msgs/String", OTHER)}}
    ((conflict,), warnings) = judged(live)
    assert warnings == []
    assert f"/talker publishes /chatter as std_msgs/String with md5sum {OTHER}, not {STRING} (add" in conflict
    assert [len(found) for found in judged(live, forced=True)] == [0, 1]
    assert judged(live, shadow=("a",))[0] == []


def test_another_definition_of_a_topic_in_force_is_judged_again() -> None:
    live = {"/chatter": {"/talker": LiveType("std_msgs/String", OTHER)}}
    before = msgspec.structs.replace(CODE, texts={"std_msgs/String": "string data\nstring more\n"})
    assert judge_topics(CODE, CODE, live, shadow=(), forced=False).conflicts == []
    assert len(judge_topics(CODE, before, live, shadow=(), forced=False).conflicts) == 1


DEADMAN = """\
deadman() {
    bool stopped;
    event drive() /cmd_vel geometry_msgs/Twist '{}' { if (stopped) { return; } }
    event silent() every 300ms { stopped = true; }
}
"""
DRIVING = {"/cmd_vel": {"/teleop": LiveType("geometry_msgs/Twist")}}
CHANGED = DEADMAN.replace("300ms", "500ms")


def held(
    text: str, live: dict[str, dict[str, LiveType]] = DRIVING, before: str = DEADMAN, **how: Any
) -> tuple[list[str], list[str]]:
    present, coming = (check(Sources({"d.rv": one}), ()) for one in (before, text))
    given: dict[str, Any] = {"acting": ["deadman"], "moved": (), "hold": False} | how
    findings = judge_holds(coming, present, live, **given)
    return findings.conflicts, findings.warnings


def test_a_change_that_holds_a_topic_with_traffic_needs_consent() -> None:
    """The robot would get no more commands, not even a stop."""
    what = (
        "deadman loses its state, because its source, or a definition, changes,"
        " and drops every message of /cmd_vel until it is resumed"
    )
    assert held(CHANGED) == (
        [
            f"d.rv:1:1: error: {what}; stop the robot, and use --hold (REST: hold=1); then rosrv monitor resume deadman"
        ],
        [],
    )
    assert held(CHANGED, hold=True) == (
        [],
        [f"d.rv:1:1: warning: {what}; when it is safe: rosrv monitor resume deadman"],
    )


def test_a_change_that_holds_a_topic_without_traffic_warns_only() -> None:
    still = LiveType("geometry_msgs/Twist", moving=False)
    conflicts, [warning] = held(CHANGED, {"/cmd_vel": {"/teleop": still}})
    assert conflicts == []
    assert "every message of /cmd_vel" in warning
    assert held(CHANGED, {"/cmd_vel": {"/a": still, **DRIVING["/cmd_vel"]}})[0] == held(CHANGED)[0]


def test_a_move_to_another_relay_that_holds_a_topic_needs_consent() -> None:
    [conflict], _ = held(DEADMAN, moved=["d.rv"])
    assert "because it moves to another relay" in conflict


@pytest.mark.parametrize(
    ("text", "how"),
    [
        (DEADMAN, {}), (f"// {DEADMAN}".replace("// ", "// a comment\n"), {}), (f"begin {CHANGED}", {}),
        (CHANGED, {"live": {}}), (CHANGED, {"acting": []}), (CHANGED.replace("return", "stopped = true"), {}),
        (CHANGED, {"before": DEADMAN.replace("deadman", "other")}),
    ],
)  # fmt: skip
def test_a_change_that_holds_nothing_needs_no_consent(text: str, how: dict[str, Any]) -> None:
    assert held(text, **how) == ([], [])
