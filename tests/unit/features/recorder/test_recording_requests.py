import json

import pytest

from appliance.channel.messages.api import ClientRequest
from appliance.channel.rest_meaning import NoOrderError, order_of
from appliance.features.recorder.requests import RecordingOfMemory


def asked(since: str) -> ClientRequest:
    """Return the request for what is in memory."""
    body = json.dumps({"since": since}).encode()
    return ClientRequest("10.0.0.1", "POST", "/v1/recordings/memory", "", "application/json", "", body)


@pytest.mark.parametrize("text", ["1h", "yesterday", "2026-13-01"])
def test_an_order_has_no_relative_date(text: str) -> None:
    """`1h` would give control and the api different times."""
    with pytest.raises(NoOrderError, match=rf"body.since: '{text}' is not a date"):
        order_of(asked(text))


def test_a_date_beyond_its_bound_names_the_field() -> None:
    with pytest.raises(NoOrderError, match=r"^since: must be at least 0"):
        order_of(asked("1969-03-01"))


def test_a_date_is_nanoseconds() -> None:
    assert order_of(asked("2026-03-01")) == RecordingOfMemory(since=1_772_323_200_000_000_000)
