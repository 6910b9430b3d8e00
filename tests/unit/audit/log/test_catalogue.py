import pytest

from appliance.audit.log.events import EVENTS
from distribution.checkout import BuildError
from distribution.generated_pages import ELSEWHERE, audit_events_markdown, uses


def test_severities_and_fields_come_from_the_code() -> None:
    found = {use.event: use for use in uses()}
    assert {"who", "method", "status", "count"} <= set(found["rest call"].fields)
    assert found["forwarding gap"].severities == {"alarm"}
    assert found["forwarding gap"].fields == ("count",)
    assert {"limit exceeded", "malformed"} <= set(found)
    assert set(found["approval given"].fields) == {"approval", "sha256", "who", "earlier", "now"}, (
        "of a helper"
    )
    assert set(found["recording missed"].fields) == {"what", "record", "charged_to", "recording"}, "of a name"
    assert {"ticket", "peer"} <= set(found["door connected"].fields), "of a partial call"
    assert found["heartbeat ended"].severities == {"alarm"}


def test_handwritten_fields_belong_to_registered_events() -> None:
    assert set(ELSEWHERE) <= set(EVENTS)


@pytest.mark.parametrize("event", ["evidence exported", "monitor called"])
def test_a_page_without_the_fields_of_an_event_is_refused(
    monkeypatch: pytest.MonkeyPatch, event: str
) -> None:
    monkeypatch.delitem(ELSEWHERE, event)
    with pytest.raises(BuildError, match=f"no call shows the fields of {event}"):
        audit_events_markdown()
