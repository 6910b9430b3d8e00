import pytest

from appliance.channel.messages import (
    ClientGranted,
    GrantInstalled,
    NodePlaced,
    PublicationPlaced,
    ServicePlaced,
)
from appliance.relay.connections.admission import asked_for, bound_name, flaw, missing
from appliance.relay.connections.headers import canonical
from appliance.relay.grant_table import GrantTable

TOPIC = {"topic": "/chatter", "md5sum": "*", "callerid": "/listener"}
SERVICE = {"service": "/mode", "md5sum": "*", "callerid": "/client"}


@pytest.mark.parametrize(
    ("fields", "asked"), [(TOPIC, ("topic", "/chatter")), (SERVICE, ("service", "/mode")), ({}, ("", ""))]
)
def test_a_header_names_its_topic_or_service(fields: dict[str, str], asked: tuple[str, str]) -> None:
    assert asked_for(fields) == asked


@pytest.mark.parametrize("fields", [TOPIC, SERVICE])
@pytest.mark.parametrize("field", ["md5sum", "callerid"])
def test_a_required_field_is_named_when_it_is_missing(fields: dict[str, str], field: str) -> None:
    assert flaw(fields, b"") == ""
    less = {name: value for name, value in fields.items() if name != field}
    assert flaw(less, b"") == f"Missing required '{field}' field"


def test_a_client_may_send_its_request_with_the_header_a_subscriber_nothing() -> None:
    assert flaw(SERVICE, b"request") == ""
    assert "one topic" in flaw(TOPIC, b"more")


def test_the_reason_says_what_is_missing_until_nothing_is() -> None:
    table = GrantTable()
    table.state(NodePlaced("k", "/talker", "10.0.0.1"))
    assert missing(table, "k", "10.0.0.2", TOPIC) == "[/talker] is not a publisher of [/chatter]"
    table.state(PublicationPlaced("k", "/chatter", "*"))
    assert "no grant for [/listener] at 10.0.0.2" in missing(table, "k", "10.0.0.2", TOPIC)
    table.state(GrantInstalled("k", "/chatter", "10.0.0.2", "/listener"))
    assert missing(table, "k", "10.0.0.2", TOPIC) == ""
    assert "not a provider" in missing(table, "k", "10.0.0.2", SERVICE)
    table.state(ServicePlaced("k", "/mode", "10.0.0.1", 1))
    assert "no grant for [/client] at 10.0.0.2" in missing(table, "k", "10.0.0.2", SERVICE)
    table.state(ClientGranted("k", "/mode", "10.0.0.2", "/client"))
    assert missing(table, "k", "10.0.0.2", SERVICE) == ""


@pytest.mark.parametrize("kind", [TOPIC, SERVICE])
@pytest.mark.parametrize("name", ["", "listener", "/", "/a\nb", "/" + "a" * 2000, "/é"])
def test_an_invalid_callerid_is_refused(kind: dict[str, str], name: str) -> None:
    assert "caller_id" in flaw(kind | {"callerid": name}, b"")
    assert flaw(kind | {"callerid": "/rosservice-4711"}, b"") == ""


def test_a_peer_has_the_canonical_form_of_its_name() -> None:
    assert canonical(TOPIC | {"callerid": "//listener/"}) == TOPIC | {"callerid": "/listener"}
    assert canonical(SERVICE | {"callerid": "listener"}) == SERVICE | {"callerid": "listener"}
    assert canonical({"topic": "/chatter"}) == {"topic": "/chatter"}


def test_a_client_calls_under_the_name_of_its_lookup() -> None:
    table = GrantTable()
    for message in (
        NodePlaced("k", "/server", "10.0.0.1"),
        ServicePlaced("k", "/mode", "10.0.0.1", 1),
        ClientGranted("k", "/mode", "10.0.0.2", "/client"),
    ):
        table.state(message)
    other = SERVICE | {"callerid": "/listener"}
    assert bound_name(table, "k", "10.0.0.2", SERVICE) == "/client"
    assert bound_name(table, "k", "10.0.0.2", other) is None
    assert "no grant for [/listener]" in missing(table, "k", "10.0.0.2", other)
    probe = other | {"probe": "1"}
    assert bound_name(table, "k", "10.0.0.2", probe) == "/client"
    assert missing(table, "k", "10.0.0.2", probe) == ""
    assert "no grant" in missing(table, "k", "10.0.0.3", probe)
    table.withdraw(("client", "k", "/mode", "10.0.0.2", "/client"))
    assert "no grant" in missing(table, "k", "10.0.0.2", probe)
