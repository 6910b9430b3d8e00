"""Tests of the registry of events against the program."""

from appliance.audit.events import EVENTS, SEVERITIES
from distribution.audit_events_page import uses


def test_whatever_is_recorded_is_in_the_registry() -> None:
    """Every event that some part of the program records has its name and description in the registry."""
    found = {use.event: use.place for use in uses()}
    assert {"checkpoint", "policy loaded", "rest call"} <= set(found)
    assert {name: where for name, where in found.items() if name not in EVENTS} == {}


def test_severities_are_of_events_that_there_are() -> None:
    """A severity of the registry is that of an event in it."""
    assert SEVERITIES.keys() <= EVENTS.keys()
