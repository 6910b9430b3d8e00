import pytest

from appliance.audit.log.events import EVENTS, SEVERITIES
from distribution.generated_pages import recorded_events, uses, written_by


def test_every_recorded_event_is_registered() -> None:
    found = {use.event: use.place for use in uses()}
    assert {"checkpoint", "policy loaded", "rest call"} <= set(found)
    assert {name: where for name, where in found.items() if name not in EVENTS} == {}


def test_every_documented_event_is_recorded_somewhere() -> None:
    assert EVENTS.keys() - recorded_events() == set()


@pytest.mark.parametrize(
    ("text", "found"),
    [
        ('trail.happened("process died", "why")', True),
        ('T = {1: "process died"}\ntrail.happened(T[1], "why")', True),
        ('log.error("process died", role=1)\ntrail.happened(name, "why")', False),
        ('if event == "process died":\n    trail.happened(event, "why")', False),
        ('GAPS = ("process died",)', False),
    ],
)
def test_a_name_that_is_printed_compared_or_listed_records_nothing(text: str, found: bool) -> None:
    assert ("process died" in set(written_by(text))) is found


def test_severities_belong_to_registered_events() -> None:
    assert SEVERITIES.keys() <= EVENTS.keys()
