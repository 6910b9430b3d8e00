from appliance.audit.log.events import EVENTS, SEVERITIES
from distribution.audit_events_page import uses


def test_every_recorded_event_is_registered() -> None:
    found = {use.event: use.place for use in uses()}
    assert {"checkpoint", "policy loaded", "rest call"} <= set(found)
    assert {name: where for name, where in found.items() if name not in EVENTS} == {}


def test_severities_belong_to_registered_events() -> None:
    assert SEVERITIES.keys() <= EVENTS.keys()
