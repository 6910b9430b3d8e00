"""Check a peer's header for flaws, and compare it with the grant table.

roscpp never retries after an error header, so a peer without a grant waits for `RelayLimits.grant_seconds`, and until
a restatement ends.
"""

from collections.abc import Mapping

from appliance.channel.messages.relay_link import NO_GRANT
from appliance.relay.connections.headers import switched_on, too_long
from appliance.relay.grant_table import GrantTable
from roswire.errors import InvalidNameError
from roswire.names import canonical_tool_id

_KINDS = ("topic", "service")
_REQUIRED = ("md5sum", "callerid")

NOTHING = ("", "")
"""The kind and name for a header that names neither a topic nor a service."""


def asked_for(fields: Mapping[str, str]) -> tuple[str, str]:
    return next(((kind, fields[kind]) for kind in _KINDS if fields.get(kind)), NOTHING)


def flaw(fields: Mapping[str, str], rest: bytes) -> str:
    """Return why a header is rejected, in rospy's words where possible; empty if it is valid."""
    if "topic" in fields and "service" in fields:
        return "its header names a topic and a service; a connection is for one of them"
    if "topic" not in fields and "service" not in fields:
        return "its header names neither a topic nor a service"
    for field in _REQUIRED:
        if field not in fields:
            return f"Missing required '{field}' field"
    try:
        canonical_tool_id(fields["callerid"])
    except InvalidNameError as error:
        return str(error)
    if "topic" in fields and rest:
        return "sent data after its header; a connection is for one topic"
    return too_long(fields)


def missing(table: GrantTable, key: str, host: str, fields: Mapping[str, str]) -> str:
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
    """Return the name under which a client calls a service; None if it may not.

    roswtf looks up a service under one name and probes it under another (`/rosservice`). A probe calls nothing, so it
    gets the name of the lookup.
    """
    caller_id, service = fields["callerid"], fields["service"]
    if table.may_call(key, service, host, caller_id):
        return caller_id
    return table.client_of(key, service, host) if switched_on(fields, "probe") else None
