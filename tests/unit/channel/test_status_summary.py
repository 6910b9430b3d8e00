from typing import Any

import pytest

from appliance.channel.answers.status import ProcessInfo, Status
from appliance.channel.status_summary import no_relay, process_names, why_unserved
from tests.support.answers import example

SERVING: dict[str, Any] = {
    "probe": "passed",
    "relay": "connected",
    "rosmaster": "reachable",
}


def test_a_serving_appliance_has_no_reason() -> None:
    assert why_unserved(example(Status, **SERVING)) is None
    assert why_unserved(example(Status, **SERVING | {"probe": ""})) is None
    audit = {"failed": "disk full", "on_failure": "allow"}
    assert why_unserved(example(Status, **SERVING, audit=audit)) is None


@pytest.mark.parametrize(
    ("wrong", "reason"),
    [
        ({"probe": "ROSMaster can be reached"}, "not hidden: ROSMaster can be reached"),
        (
            {"audit": {"failed": "disk full", "on_failure": "deny"}},
            "the audit log cannot be written: disk full",
        ),
        ({"relay": "away"}, "no relay process"),
        ({"relay": "1 of 2 are away"}, "of the relay processes 1 of 2 are away"),
        ({"rosmaster": "being rebuilt"}, "the ROS master is being rebuilt"),
    ],
)
def test_reasons_for_not_serving_are_named(wrong: dict[str, Any], reason: str) -> None:
    assert reason in str(why_unserved(example(Status, **SERVING | wrong)))


def test_one_missing_relay_is_counted() -> None:
    assert no_relay("connected") is None
    assert no_relay("1 of 3 are away") != no_relay("away")


def test_processes_of_one_role_are_numbered() -> None:
    rows = [example(ProcessInfo, role=role) for role in ("control", "relay", "api", "relay")]
    assert process_names(rows) == ["control", "relay 0", "api", "relay 1"]
