from appliance.audit.log.events import EVENTS
from distribution.generated_pages import ELSEWHERE, uses


def test_severities_and_fields_come_from_the_code() -> None:
    found = {use.event: use for use in uses()}
    assert {"who", "method", "status", "count"} <= set(found["rest call"].fields)
    assert found["forwarding gap"].severities == {"alarm"}
    assert found["forwarding gap"].fields == ("count",)
    assert {"limit exceeded", "malformed"} <= set(found)


def test_handwritten_fields_belong_to_registered_events() -> None:
    assert set(ELSEWHERE) <= set(EVENTS)
