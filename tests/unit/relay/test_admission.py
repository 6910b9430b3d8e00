"""What a header lacks, in itself and in the table."""

import pytest

from appliance.channel.messages import (
    ClientGranted,
    GrantInstalled,
    NodePlaced,
    PublicationPlaced,
    ServicePlaced,
)
from appliance.relay.admission import asked_for, flaw, missing
from appliance.relay.grants import StatedTable

TOPIC = {"topic": "/chatter", "md5sum": "*", "callerid": "/listener"}
SERVICE = {"service": "/mode", "md5sum": "*", "callerid": "/client"}


@pytest.mark.parametrize(("fields", "resource"), [(TOPIC, "/chatter"), (SERVICE, "/mode"), ({}, "")])
def test_a_header_names_what_is_asked_for(fields: dict[str, str], resource: str) -> None:
    """For the report of a refusal."""
    assert asked_for(fields) == resource


@pytest.mark.parametrize("fields", [TOPIC, SERVICE])
@pytest.mark.parametrize("field", ["md5sum", "callerid"])
def test_a_required_field_is_named_when_it_is_missing(fields: dict[str, str], field: str) -> None:
    """In rospy's words, which users search for."""
    assert flaw(fields, b"") == ""
    less = {name: value for name, value in fields.items() if name != field}
    assert flaw(less, b"") == f"Missing required '{field}' field"


def test_a_client_may_send_its_request_with_the_header_a_subscriber_nothing() -> None:
    """A subscriber has nothing to say after its header."""
    assert flaw(SERVICE, b"request") == ""
    assert "one topic" in flaw(TOPIC, b"more")


def test_the_reason_says_what_is_missing_until_nothing_is() -> None:
    """First the publication, then the grant; likewise for a service."""
    table = StatedTable()
    table.state(NodePlaced("k", "/talker", "10.0.0.1"))
    assert missing(table, "k", "10.0.0.2", TOPIC) == "[/talker] is not a publisher of [/chatter]"
    table.state(PublicationPlaced("k", "/chatter", "*"))
    assert "no grant for [/listener] at 10.0.0.2" in missing(table, "k", "10.0.0.2", TOPIC)
    table.state(GrantInstalled("k", "/chatter", "10.0.0.2", "/listener"))
    assert missing(table, "k", "10.0.0.2", TOPIC) == ""
    assert "not a provider" in missing(table, "k", "10.0.0.2", SERVICE)
    table.state(ServicePlaced("k", "/mode", "10.0.0.1", 1))
    assert "no grant for 10.0.0.2" in missing(table, "k", "10.0.0.2", SERVICE)
    table.state(ClientGranted("k", "/mode", "10.0.0.2"))
    assert missing(table, "k", "10.0.0.2", SERVICE) == ""
