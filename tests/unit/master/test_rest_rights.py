"""Tests of `appliance.master.rest_rights`: every request that can come over REST has its role."""

from typing import get_args

import pytest

from appliance.channel import admin
from appliance.channel.messages import TokenKept
from appliance.master import rest_rights
from appliance.master.rest_rights import obstacle

TOKENS = [TokenKept("0", role, role, b"", b"", 1e12) for role in ("viewer", "operator", "admin")]
FOR_NOBODY = {
    admin.StatusWanted, admin.PolicyWanted, admin.PolicyRevisions, admin.RegistrationsWanted, admin.GraphWanted,
    admin.MetricsWanted, admin.MonitorsWanted, admin.HostList, admin.HostEnrol, admin.HostRenewItself,
    admin.HostRenewed, admin.RevocationsWanted, admin.AuthorityWanted, admin.HostEndpoint,
}  # fmt: skip


def test_no_request_was_forgotten() -> None:
    """A request that is added is given to admins, to operators, or is here as one that only looks."""
    listed = {*rest_rights._ADMINS, *rest_rights._OPERATORS}
    assert listed | FOR_NOBODY == set(get_args(admin.RestRequest))
    assert not listed & FOR_NOBODY


@pytest.mark.parametrize(
    ("request_", "may"),
    [
        (admin.PolicyLoad("x"), {"admin"}),
        (admin.HostRevoke("x"), {"admin"}),
        (admin.PolicyReload(), {"admin", "operator"}),
        (admin.MonitorSwitch(["x"], False), {"admin", "operator"}),
    ],
)
def test_who_may_change(request_: admin.RestRequest, may: set[str]) -> None:
    """A change needs a token of that name whose role may; the name of no token is nobody's."""
    assert {one.name for one in TOKENS if obstacle(request_, one.name, TOKENS) is None} == may
    for nobody in ("operator ", "disk", "", "the host itself"):
        assert "no token" in (obstacle(request_, nobody, TOKENS) or "")
