from appliance.channel import admin
from appliance.channel.admin import operation_of
from appliance.channel.messages.api import ClientRequest
from appliance.channel.rest_meaning import order_of
from appliance.features.tunnels.requests import HostPorts, HostToken


def test_a_kind_of_request_can_have_several_ways() -> None:
    found = [operation_of(HostToken("laptop", new=new)) for new in (True, False)]
    assert [one.path for one in found if one] == ["/v1/hosts", "/v1/hosts/{name}/token"]
    assert operation_of(admin.TokenAdd("ci", "viewer", 60)) is None


def test_a_date_is_seconds() -> None:
    body = b'{"state": "open", "checked": "2026-03-01T00:00:00.5Z"}'
    ports = ClientRequest("10.0.0.1", "PUT", "/v1/hosts/laptop/ports", "*", "application/json", "", body)
    assert order_of(ports) == HostPorts("laptop", "open", checked=1_772_323_200.5)
