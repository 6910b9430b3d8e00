"""What specifications would mean for the topics that are published now."""

from collections.abc import Collection

import pytest

from appliance.specifications.checking import check
from appliance.specifications.live_topics import judge_topics
from appliance.specifications.specification_files import (
    Checked,
    Sources,
)

TEXT = """\
a() {
    event said() /chatter std_msgs/String '{}' { std_msgs::String report; PUBLISH(/alarm, std_msgs/String, report); }
}
"""
CODE = check(Sources({"a.rv": TEXT}), ())
LIVE: dict[str, dict[str, str]] = {"/chatter": {"/talker": "std_msgs/String"}}


def judged(
    live: dict[str, dict[str, str]], *, shadow: Collection[str] = (), forced: bool = False
) -> tuple[list[str], list[str]]:
    """What is said of the specification, which is new."""
    found = judge_topics(CODE, Checked(), live, shadow=shadow, forced=forced)
    return found.conflicts, found.warnings


def test_what_fits_the_robot_is_not_mentioned() -> None:
    """A topic with the publisher's type, or with one that its publisher leaves open, is no finding."""
    assert judged(LIVE) == ([], [])
    assert judged({"/chatter": {"/talker": "*"}}) == ([], [])


def test_a_topic_that_monitors_publish_has_one_type() -> None:
    """A monitor that would publish another type than a node does is a conflict at the statement, unless forced."""
    live = LIVE | {"/alarm": {"/siren": "std_msgs/Bool"}}
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
    ("live", "hint"), [({"/chater": {"/t": "std_msgs/String"}}, "; did you mean /chater?"), ({}, "")]
)
def test_a_topic_without_a_publisher_is_a_warning(live: dict[str, dict[str, str]], hint: str) -> None:
    """The nearest live name is named where there is one; what monitors publish themselves needs no publisher."""
    assert judged(live) == ([], [f"a.rv:2:5: warning: no node publishes /chatter now{hint}"])
