"""Tests of `appliance.channel.admin`: every request that REST can make has a route and a role."""

from appliance.channel import admin
from appliance.channel.admin import operation_of
from appliance.channel.operations import CHANGES, OPERATIONS


def test_changes_are_for_operators_and_admins() -> None:
    """Each change requires one of these roles, or makes messages that only investigators may fetch.

    Some requests for these roles change nothing: the lists of tokens and sessions, a kit, a query, a check.
    """
    listed = {one.request for one in OPERATIONS if one.role in ("operator", "admin")}
    reads = {str(request.__struct_config__.tag) for request in listed - CHANGES}
    assert reads - {"sso list"} == {"token list", "host kit", "topic look", "monitor try"}
    assert {str(request.__struct_config__.tag) for request in CHANGES - listed} <= {
        "recording memory",
        "sso sign out",
    }


def test_a_kind_of_request_can_have_several_ways() -> None:
    """A token can be for a new host or for an enrolled one."""
    found = [operation_of(admin.HostToken("laptop", new=new)) for new in (True, False)]
    assert [one.path for one in found if one] == ["/v1/hosts", "/v1/hosts/{name}/token"]
    assert operation_of(admin.TokenAdd("ci", "viewer", 60)) is None
