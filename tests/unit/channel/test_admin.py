"""Tests of `appliance.channel.admin`: every request that can come over REST has its way and its role."""

from appliance.channel import admin
from appliance.channel.admin import CHANGES, OPERATIONS, operation_of


def test_what_changes_something_is_for_operators_and_admins() -> None:
    """Each change is for one of both, or has messages written that only investigators may fetch.

    What both may do and changes nothing is the list of tokens, a kit, a look, a try of specifications.
    """
    listed = {one.request for one in OPERATIONS if one.role in ("operator", "admin")}
    assert listed - CHANGES == {admin.TokenList, admin.HostKit, admin.TopicLook, admin.MonitorTry}
    assert CHANGES - listed == {admin.RecordingOfMemory}


def test_requests_of_one_kind_can_be_asked_differently() -> None:
    """A token for a host that comes for the first time, and for one that is enrolled."""
    found = [operation_of(admin.HostToken("laptop", new=new)) for new in (True, False)]
    assert [one.path for one in found if one] == ["/v1/hosts", "/v1/hosts/{name}/token"]
    assert operation_of(admin.TokenAdd("ci", "viewer", 60)) is None
