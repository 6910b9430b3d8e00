"""Tests of `appliance.api.health`."""

from appliance.api.health import Status


def test_what_control_adds_is_passed_on() -> None:
    """A section of the status that a newer part of the appliance adds is shown, not a failure."""
    fields = {
        "version": "1", "master": "http://10.0.0.1:11311", "since": 1.0,
        "processes": [{"role": "control", "pid": 1, "since": "-", "restarts": 0}],
        "isolation": "none", "relaying": "all", "mediation": "full", "firewall": {}, "probe": "",
        "policy": {
            "revision": 1, "file": "f", "source": "f", "who": "disk", "differs_from_file": False, "warnings": 0,
            "confirm_by": None,
        },
        "rosmaster": "reachable", "relay": "connected", "nodes": 0, "shadows": 0, "topics": 0, "services": 0,
        "connections": 0, "messages": 0, "dropped": 0,
        "audit": {"lag_records": 0, "lag_seconds": 0.0, "failed": None, "degraded": None},
    }  # fmt: skip
    assert Status.model_validate(fields | {"tunnels": [1]}).model_dump() == fields | {"tunnels": [1]}
