"""Whether a peer's header may be served: what it lacks in itself, and what it lacks in the table.

The first is refused at once. The second may only be missing *yet*: a grant is on its way on the link while
the peer is faster, or a new control (or this new relay) is being told everything and has not come to it.
roscpp never tries again after an error header, so such a peer is kept waiting for a moment instead
(`Limits.grant_seconds`, and for as long as a restatement goes on).
"""

from collections.abc import Mapping

from appliance.channel.messages.relay_link import NO_GRANT
from appliance.relay.connections.headers import switched_on, too_long
from appliance.relay.granted import StatedTable
from roswire.errors import InvalidNameError
from roswire.names import check_tool_id

_REQUIRED = {"topic": ("md5sum", "callerid"), "service": ("md5sum", "callerid")}

NOTHING = ("", "")
"""What a header asks for that names neither a topic nor a service, or is not there."""


def asked_for(fields: Mapping[str, str]) -> tuple[str, str]:
    """The kind and the name of the topic or service a header names; both empty when it names neither."""
    return next(((kind, fields[kind]) for kind in _REQUIRED if fields.get(kind)), NOTHING)


def flaw(fields: Mapping[str, str], rest: bytes) -> str:
    """Why nobody may be served with such a header, in the words of rospy where it has some; empty when all is well."""
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


def missing(table: StatedTable, key: str, host: str, fields: Mapping[str, str]) -> str:
    """What the table lacks for this peer to be served at the port of incarnation `key`; empty when nothing."""
    node = table.node(key)
    name = key if node is None else node.name
    caller_id = fields["callerid"]
    if "topic" in fields:
        topic = fields["topic"]
        if table.publication(key, topic) is None:
            return f"[{name}] is not a publisher of [{topic}]"
        if not table.may_subscribe(key, topic, host, caller_id):
            return f"{NO_GRANT} [{caller_id}] at {host} to subscribe to [{topic}]; requestTopic comes first"
        return ""
    service = fields["service"]
    if table.service(key, service) is None:
        return f"[{name}] is not a provider of [{service}]"
    if bound_name(table, key, host, fields) is None:
        return f"{NO_GRANT} [{caller_id}] at {host} to call [{service}]; lookupService comes first"
    return ""


def bound_name(table: StatedTable, key: str, host: str, fields: Mapping[str, str]) -> str | None:
    """The name under which a client may call a service: its own, which it has looked the service up by.

    A probe calls nothing. The tools that probe may have looked the service up by another name (roswtf probes as
    `/rosservice`): the service sees that one.
    """
    caller_id, service = fields["callerid"], fields["service"]
    if table.may_call(key, service, host, caller_id):
        return caller_id
    return table.client_of(key, service, host) if switched_on(fields, "probe") else None
