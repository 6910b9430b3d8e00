"""Name hosts and the robot in text for people and in exports, as the running appliance does.

A stopped appliance, a copy of a log and a standby have no policy in force, so their hosts are shown by address.
"""

import ipaddress
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING

import msgspec

from appliance.api.routes.named_hosts import HostLabels, host_in_words
from appliance.channel.admin import PolicyWanted, StatusWanted
from appliance.cli.connection.admin_client import AdminSocket, NotRunningError
from appliance.policy.host_names import HostInWords, in_words

if TYPE_CHECKING:
    from appliance.cli.connection.rest_orders import RestWay

_SECONDS, _GRACE_SECONDS = 2.0, 0.1  # an appliance that hangs must not keep an operator from reading the log


def named_by(way: "AdminSocket | RestWay") -> HostInWords:
    """Return the function that shows a host as text for people."""
    if isinstance(way, AdminSocket):
        return _named_by_socket(way.state)
    return _named_by_rest(way)


def robot_name(state: Path) -> str:
    """Return the name of the robot; empty if it has none, or no appliance is in service."""
    try:
        answer = AdminSocket(state, _SECONDS, _GRACE_SECONDS).ask(StatusWanted())
    except NotRunningError:
        return ""
    return answer.given().name if answer.ok else ""


def _named_by_socket(state: Path) -> HostInWords:
    try:
        answer = AdminSocket(state, _SECONDS, _GRACE_SECONDS).ask(PolicyWanted())
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
