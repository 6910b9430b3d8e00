from typing import Any

import msgspec
import pytest

from appliance.channel.answers.status import AuditState, Status
from appliance.features.view import StateView
from appliance.features.views import STATES, states_in, states_of
from tests.support.answers import example

AUDIT = "lag_records lag_seconds failed on_failure degraded replaced forwarding collector"
STATUS = (
    "version since master processes isolation relaying mediation firewall probe policy ipsec monitors rosmaster relay"
    " nodes shadows topics services connections messages dropped audit clock recorder switched_off blocks last_minute"
    " name standby bundles doors adopt handled_alarms starting new_state tokens_ending now approvals guards authority"
)
TO: dict[str, Any] = {"to": "tls://log:6514", "behind": 7}
DOOR = {
    "name": "alice", "up": False, "trouble": "port 9091 cannot be listened on", "connections": 32, "limit": 32,
    "full_seconds": 60.0, "received": 1, "sent": 2, "received_bytes": 3, "sent_bytes": 4, "dropped": 5, "refusals": 6,
    "refused_connections": 7, "restarts": 9, "restarts_lately": 3,
}  # fmt: skip
BAD: dict[str, tuple[dict[str, Any], list[tuple[str, str]]]] = {
    "authority": (
        {"unheard": [{"group": "base", "why": "no host holds base", "hosts": [
            {"host": "10.0.0.5", "topic": "/cmd_vel", "nodes": ["/teleop"], "order": "rosrv drive assign base"}]}]},
        [("not-carried:base", "notice")],
    ),
    "forwarding": (TO | {"trouble": "refused"}, [("audit-not-forwarded", "warning")]),
    "collector": (TO | {"trouble": "refused"}, [("audit-not-collected", "warning")]),
    "recorder": ({"running": False}, [("recorder", "warning")]),
    "standby": (
        {"role": "active", "obstacle": "other keys"},
        [("standby-unready", "alarm"), ("witness-silent", "warning")],
    ),
    "doors": (
        {"doors": [DOOR]},
        [("doors-down", "warning"), ("doors-restarting", "warning"), ("doors-full", "warning")],
    ),
    "approvals": (
        {"waiting": 1, "oldest_seconds": 2.5, "leases": 3, "unanswered": 4, "unsent": 5, "unsent_why": "away"},
        [("approval-unanswered", "warning"), ("approval-hook", "warning")],
    ),
    "guards": (
        {"loaded": 2, "acting": [{"name": "fence", "since": 1.5}], "heartbeat": "a relay is late"},
        [("guard-acts:fence", "notice"), ("heartbeat-off", "alarm")],
    ),
    "adopt": (
        {
            "phase": "free", "wanted": True, "since_utc": "2026-11-28T12:00:00Z", "master": "/usr/bin/rosmaster",
            "present": True, "obstacle": "another master", "nodes": 0, "not_started": 0, "denied": {}, "missing": {},
        },
        [("adoption", "alarm")],
    ),
    "bundles": (
        {"refused": "a/b/2.tar", "reason": "no", "trouble": "bad", "rejected": True, "changed": True},
        [("bundle-refused", "warning"), ("bundles-rejected", "alarm"), ("bundle-changed", "notice")],
    ),
}  # fmt: skip


def test_the_status_has_the_documented_fields() -> None:
    assert " ".join(AuditState.__struct_fields__) == AUDIT
    assert " ".join(Status.__struct_fields__) == STATUS
    required = {
        field.name
        for kind in (AuditState, Status)
        for field in msgspec.structs.fields(kind)
        if field.required
    }
    assert {view.field for view in STATES} & required == {"forwarding"}


def test_a_feature_without_a_state_is_null() -> None:
    assert states_in({}, "audit") == {"forwarding": None, "collector": None}
    status = example(Status)
    assert list(states_of(status)) == []
    assert msgspec.to_builtins(status)["recorder"] is None


@pytest.mark.parametrize("view", STATES, ids=lambda view: view.field)
def test_each_state_has_its_alarms_metrics_and_line(view: StateView[Any]) -> None:
    given, alarms = BAD[view.field]
    place = {"audit": {view.field: given}} if view.part == "audit" else {view.field: given}
    status = msgspec.json.decode(msgspec.json.encode(example(Status, **place)), type=Status)
    [(found, state)] = states_of(status)
    assert found is view
    assert [
        (alarm.kind, view.kinds[alarm.kind.partition(":")[0]].severity) for alarm in view.alarms(state)
    ] == alarms
    assert set(view.samples(state)) == {metric.name for metric in view.metrics}
    assert view.line is not None
    assert str(view.line(state)[1])
