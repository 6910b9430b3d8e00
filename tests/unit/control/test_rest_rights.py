"""Tests of `appliance.control.rest_rights`: every request that can come over REST has its role."""

from typing import get_args

from appliance.channel import admin
from appliance.control import rest_rights


def test_no_request_was_forgotten() -> None:
    """A request that is added is given to one role, or is here as one that needs no token."""
    lists = (rest_rights._ADMINS, rest_rights._OPERATORS, rest_rights._VIEWERS, rest_rights._NOBODYS)
    assert sorted(one.__name__ for listed in lists for one in listed) == sorted(
        one.__name__ for one in get_args(admin.RestRequest)
    )


def test_what_changes_something_is_for_operators_and_admins() -> None:
    """Each change is in one of both lists; what both may do and changes nothing is the list of tokens, and a kit."""
    changes = set(get_args(admin.RestChange))
    listed = {*rest_rights._ADMINS, *rest_rights._OPERATORS}
    assert changes <= listed
    assert listed - changes == {admin.TokenList, admin.HostKit}
