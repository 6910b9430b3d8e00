"""Check a peer's header: for flaws of its own, and against the grant table.

A flawed header is refused at once. A missing grant may be on its way: on the link, or in the restatement of a new
control. roscpp never tries again after an error header, so such a peer waits (`RelayLimits.grant_seconds`, and for as
long as a restatement goes on).
"""

from collections.abc import Mapping

from appliance.channel.messages.relay_link import NO_GRANT
from appliance.relay.connections.headers import switched_on, too_long
from appliance.relay.grant_table import GrantTable
from roswire.errors import InvalidNameError
from roswire.names import check_tool_id

_REQUIRED = {"topic": ("md5sum", "callerid"), "service": ("md5sum", "callerid")}

NOTHING = ("", "")
"""Stands for a header that names neither a topic nor a service, or is missing."""


def asked_for(fields: Mapping[str, str]) -> tuple[str, str]:
    """Return the kind and the name of the topic or service in a header; two empty strings if there is none."""
    return next(((kind, fields[kind]) for kind in _REQUIRED if fields.get(kind)), NOTHING)


def flaw(fields: Mapping[str, str], rest: bytes) -> str:
    """Return why a header is rejected, in rospy's words where it has any; empty if the header is valid."""
    if "topic" in fields and "service" in fields:
        return "its header names a topic and a service; a connection is for one of them"
    for kind, required in _REQUIRED.items():
        if kind in fields:
            for field in required:
                if field not in fields:
                    return f"Missing required '{field}' field"
            try:
                check_tool_id(fields["callerid"])
            except InvalidNameError as error:
                return str(error)
            if kind == "topic" and rest:
                return "sent data after its header; a connection is for one topic"
            return too_long(fields)
    return "its header names neither a topic nor a service"


def missing(table: GrantTable, key: str, host: str, fields: Mapping[str, str]) -> str:
    """Return what the table lacks to serve this peer at the port of incarnation `key`; empty if nothing."""
    node = table.node(key)
    name = key if node is None else node.name
    caller_id = fields["callerid"]
    if "topic" in fields:
        topic = fields["topic"]
        if table.publication(key, topic) is None:
            return f"[{name}] is not a publisher of [{topic}]"
        if table.grant(key, topic, host, caller_id) is None:
            return f"{NO_GRANT} [{caller_id}] at {host} to subscribe to [{topic}]; requestTopic comes first"
        return ""
    service = fields["service"]
    if table.service(key, service) is None:
        return f"[{name}] is not a provider of [{service}]"
    if bound_name(table, key, host, fields) is None:
        return f"{NO_GRANT} [{caller_id}] at {host} to call [{service}]; lookupService comes first"
    return ""


def bound_name(table: GrantTable, key: str, host: str, fields: Mapping[str, str]) -> str | None:
    """Return the name under which a client calls a service: its own, under which it has looked up the service.

    A probe calls nothing. A tool may probe under another name than it looked up the service (roswtf probes as
    `/rosservice`): then the service sees the name of the look-up.
    """
    caller_id, service = fields["callerid"], fields["service"]
    if table.may_call(key, service, host, caller_id):
        return caller_id
    return table.client_of(key, service, host) if switched_on(fields, "probe") else None
