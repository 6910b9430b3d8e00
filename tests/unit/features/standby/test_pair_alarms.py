from typing import Any

import pytest

from appliance.channel.alarms import open_alarms
from appliance.features.standby.summary import UNCHECKED
from tests.unit.channel.test_alarms import changed

PAIR: dict[str, Any] = {
    "name": "a",
    "role": "active",
    "other": {"name": "b", "connected": True, "in_sync": True},
    "witness": {"answered_seconds": 0.3, "holder": "a"},
}


@pytest.mark.parametrize(
    ("more", "kind", "severity"),
    [
        ({"other": {"trouble_seconds": 60.0}}, "standby-away", "warning"),
        ({"other": {"connected": True, "trouble_seconds": 60.0}}, "standby-behind", "warning"),
        ({"witness": {"answered_seconds": 5.0}}, "witness-silent", "warning"),
        ({"witness": {}}, "witness-silent", "warning"),
        ({"obstacle": "other keys"}, "standby-unready", "alarm"),
        ({"other": {"connected": True, "witness_seconds": 5.0}}, "standby-blind", "alarm"),
        ({"witness": {"answered_seconds": 0.1, "trouble": "full"}}, "witness-disk", "alarm"),
        ({"witness": {"answered_seconds": 0.1, "holder": "b"}}, "both-active", "alarm"),
    ],
)
def test_each_condition_of_a_pair_is_an_alarm(more: dict[str, Any], kind: str, severity: str) -> None:
    (alarm,) = open_alarms(changed("standby", PAIR | more))
    assert (alarm.kind, alarm.severity, alarm.about) == (kind, severity, "system")
    assert len(alarm.text) > 5


@pytest.mark.parametrize(
    "more",
    [
        {},
        {"other": {"trouble_seconds": 59.0}},
        {"witness": {"answered_seconds": 4.9, "holder": ""}},
        {"obstacle": UNCHECKED},
    ],
)
def test_two_appliances_that_work_have_no_alarm(more: dict[str, Any]) -> None:
    assert open_alarms(changed("standby", PAIR | more)) == []
