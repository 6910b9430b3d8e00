"""Name hosts in text for people, as the running appliance does.

A stopped or waiting appliance and a copy of a log have no policy in force, so their hosts are shown by address.
"""

import ipaddress
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING

import msgspec

from appliance.api.routes.named_hosts import HostLabels, host_in_words
from appliance.channel.admin import PolicyWanted
from appliance.cli.connection.admin_client import QUICK_SECONDS, AdminSocket, NotRunningError
from appliance.policy.host_names import HostInWords, in_words

if TYPE_CHECKING:
    from appliance.cli.connection.rest_orders import RestWay


def named_by(way: "AdminSocket | RestWay") -> HostInWords:
    """Return the function that shows a host as text for people."""
    if isinstance(way, AdminSocket):
        return _named_by_socket(way.state)
    return _named_by_rest(way)


def _named_by_socket(state: Path) -> HostInWords:
    try:
        answer = AdminSocket(state, QUICK_SECONDS, 0.1).ask(PolicyWanted())
    except NotRunningError:
        return str
    return host_in_words(answer.given() if answer.ok else None)


def _named_by_rest(way: "RestWay") -> HostInWords:
    from appliance.cli.connection.rest_session import RestProblemError  # noqa: PLC0415  imports httpx

    try:
        found = msgspec.convert(way.client.call("GET", "/v1/policy/hosts"), HostLabels)
    except (NotRunningError, RestProblemError, msgspec.ValidationError):  # an earlier version has no names
        return str
    labels = [(ipaddress.ip_network(row.network), row.name) for row in found.labels]
    return partial(in_words, labels=labels)
