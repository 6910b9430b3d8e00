import json

import pytest

from appliance.channel.messages.api import ClientRequest
from appliance.channel.rest_meaning import NoOrderError, meant
from appliance.features.recorder.requests import RecordingOfMemory


@pytest.mark.parametrize("text", ["1h", "yesterday", "2026-13-01"])
def test_an_order_has_no_relative_date(text: str) -> None:
    """`1h` would give control and the api different times."""
    body = json.dumps({"since": text}).encode()
    asked = ClientRequest("10.0.0.1", "POST", "/v1/recordings/memory", "", "application/json", "", body)
    with pytest.raises(NoOrderError, match=rf"body.since: '{text}' is not a date"):
        meant(asked)


def test_a_date_beyond_its_bound_names_the_field() -> None:
    recording = ClientRequest(
        "10.0.0.1", "POST", "/v1/recordings/memory", "", "application/json", "", b'{"since": "1969-03-01"}'
    )
    with pytest.raises(NoOrderError, match=r"^since: must be at least 0"):
        meant(recording)


def test_a_date_is_nanoseconds() -> None:
    recording = ClientRequest(
        "10.0.0.1", "POST", "/v1/recordings/memory", "", "application/json", "", b'{"since": "2026-03-01"}'
    )
    assert meant(recording) == RecordingOfMemory(since=1_772_323_200_000_000_000)
