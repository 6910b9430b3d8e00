"""The connection headers that the relay writes in the name of others: known fields only, under names that are bound.

A header is a claim. What its sender says it is called is replaced by the name that control knows it by, and a field
that ROS does not have stays with the relay, so that nobody reads in it what nobody decided.
"""

from collections.abc import Mapping

_OF_CLIENT = ("md5sum", "type", "tcp_nodelay", "request_type", "response_type")
_SWITCHES = ("persistent", "probe")
_OF_SERVICE = ("md5sum", "type", "request_type", "response_type")
_OF_PUBLISHER = ("md5sum", "type", "message_definition", "latching", "tcp_nodelay")
_TRUE = frozenset({"1", "true"})


_OF_PEER = ("callerid", "topic", "service", *_OF_CLIENT, *_SWITCHES)
_LONGEST = 1024
"""Characters of a field that is kept as long as its connection: names of ROS, types, sums."""


def kept(fields: Mapping[str, str]) -> dict[str, str]:
    """What is remembered of a peer's header while it is connected."""
    return _known(fields, _OF_PEER)


def too_long(fields: Mapping[str, str]) -> str:
    """Why a header is not remembered: a field of it is longer than any name of ROS; empty when none is."""
    for name in _OF_PEER:
        if len(fields.get(name, "")) > _LONGEST:
            return f"its header has a {name} of {len(fields[name])} characters"
    return ""


def size_of(fields: Mapping[str, str]) -> int:
    """About how many bytes a header takes."""
    return sum(len(name) + len(value) for name, value in fields.items())


def switched_on(fields: Mapping[str, str], name: str) -> bool:
    """Whether a field is set, in any of the spellings that the client libraries take."""
    return fields.get(name, "").lower() in _TRUE


def to_service(fields: Mapping[str, str], caller_id: str) -> dict[str, str]:
    """What the service is told of its client."""
    switches = {name: "1" for name in _SWITCHES if switched_on(fields, name)}
    return {"callerid": caller_id, "service": fields["service"], **_known(fields, _OF_CLIENT), **switches}


def to_client(fields: Mapping[str, str], node: str) -> dict[str, str]:
    """What the client is told of the service, which this node offers."""
    return {"callerid": node, **_known(fields, _OF_SERVICE)}


def to_subscriber(fields: Mapping[str, str], node: str, topic: str) -> dict[str, str]:
    """What a subscriber is told of the publisher, which is this node."""
    return {"callerid": node, "topic": topic, **_known(fields, _OF_PUBLISHER)}


def _known(fields: Mapping[str, str], names: tuple[str, ...]) -> dict[str, str]:
    return {name: fields[name] for name in names if name in fields}
