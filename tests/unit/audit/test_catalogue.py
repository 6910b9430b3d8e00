"""Tests of the page of audit events."""

from pathlib import Path

from appliance.audit.events import EVENTS
from distribution.audit_events_page import ELSEWHERE, markdown, uses

PAGE = Path(__file__).parents[3] / "docs" / "audit-events.md"


def test_the_page_is_what_the_program_records() -> None:
    """docs/audit-events.md is current (python -m distribution.audit_events_page > docs/audit-events.md)."""
    assert PAGE.read_text() == markdown()


def test_what_is_read_off_the_program() -> None:
    """Severities and fields are those of the calls that record an event, also where it is one of two."""
    found = {use.event: use for use in uses()}
    assert {"who", "method", "status", "count"} <= set(found["rest call"].fields)
    assert found["forwarding gap"].severities == {"alarm"}
    assert found["forwarding gap"].fields == ("count",)
    assert {"limit exceeded", "malformed"} <= set(found)


def test_nothing_is_listed_for_an_event_that_is_none() -> None:
    """Fields that are written down by hand are of events of the registry."""
    assert set(ELSEWHERE) <= set(EVENTS)
