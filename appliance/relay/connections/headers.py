"""Write the connection headers for peers, services and publishers.

Received headers are not trusted: the sender gets its registered name, and fields unknown to ROS are dropped.
"""

from collections.abc import Mapping

from roswire.errors import InvalidNameError
from roswire.names import canonical_tool_id

_OF_CLIENT = ("md5sum", "type", "tcp_nodelay", "request_type", "response_type")
_SWITCHES = ("persistent", "probe")
_OF_SERVICE = ("md5sum", "type", "request_type", "response_type")
_OF_PUBLISHER = ("md5sum", "type", "message_definition", "latching", "tcp_nodelay")
_TRUE = frozenset({"1", "true"})


_OF_PEER = ("callerid", "topic", "service", *_OF_CLIENT, *_SWITCHES)
_LONGEST = 1024
"""The most characters of a header field, because the relay keeps some fields as long as the peer is connected."""


def peer_fields(fields: Mapping[str, str]) -> dict[str, str]:
    return _known(fields, _OF_PEER)


def canonical(fields: dict[str, str]) -> dict[str, str]:
    try:
        return {**fields, "callerid": canonical_tool_id(fields.get("callerid", ""))}
    except InvalidNameError:
        return fields  # admission refuses it, with the reason


def too_long(fields: Mapping[str, str]) -> str:
    for name in _OF_PEER:
        if len(fields.get(name, "")) > _LONGEST:
            return f"its header has a {name} of {len(fields[name])} characters"
    return ""


def size_of(fields: Mapping[str, str]) -> int:
    return sum(len(name) + len(value) for name, value in fields.items())


def switched_on(fields: Mapping[str, str], name: str) -> bool:
    return fields.get(name, "").lower() in _TRUE


def to_service(fields: Mapping[str, str], caller_id: str) -> dict[str, str]:
    switches = {name: "1" for name in _SWITCHES if switched_on(fields, name)}
    return {"callerid": caller_id, "service": fields["service"], **_known(fields, _OF_CLIENT), **switches}


def to_client(fields: Mapping[str, str], node: str) -> dict[str, str]:
    return {"callerid": node, **_known(fields, _OF_SERVICE)}


def to_subscriber(fields: Mapping[str, str], node: str, topic: str) -> dict[str, str]:
    return {"callerid": node, "topic": topic, **_known(fields, _OF_PUBLISHER)}


def _known(fields: Mapping[str, str], names: tuple[str, ...]) -> dict[str, str]:
    return {name: fields[name] for name in names if name in fields}
