"""The kinds of parameters that calls have, and the one canonical value each is turned into before a decision.

A name becomes what ROSMaster would resolve it to; a URI is parsed; anything else is a `PeerError` that names
the parameter, as ROSMaster's own validators would.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any, Generic, TypeVar

from appliance.master.caller import ApiUri
from appliance.ros import names
from appliance.ros.errors import InvalidNameError, PeerError, ProtocolError
from appliance.ros.uris import parse_node_uri, parse_service_uri
from appliance.ros.xmlrpc import Value

T = TypeVar("T")


@dataclass(frozen=True, slots=True)
class Parameter(Generic[T]):
    """One parameter of a call: its name in the ROS documentation, and how its value is made a canonical one.

    `resource`: it names the topic, service or ROS parameter that a call with it is about. `recorded`: the record of a
    command has it; it is a resolved name, short, and what a reviewer asks for.
    """

    name: str
    canonicalise: Callable[[Value, str], T]
    resource: bool = False
    recorded: bool = False


def _text(value: Value, _caller_id: str) -> str:
    if not isinstance(value, str):
        raise ProtocolError(f"must be a string, not {_type_name(value)}")
    return value


def _name(value: Value, caller_id: str) -> str:
    return names.resolve(_filled(value), caller_id)


def _subgraph(value: Value, caller_id: str) -> str:
    text = _text(value, caller_id)
    return names.resolve_namespace(text, caller_id) if text else ""


def _key(value: Value, caller_id: str) -> str:
    return names.resolve_parameter(_filled(value), caller_id)


def _search_key(value: Value, caller_id: str) -> str:
    text = _filled(value)
    if text.startswith("~"):
        raise InvalidNameError(f"{text!r} is private: searchParam takes a relative or global name")
    names.resolve_parameter(text, caller_id)
    return text


def _type(value: Value, _caller_id: str) -> str:
    text = _filled(value)
    if not names.is_valid_type_name(text):
        raise InvalidNameError(f"{text[:80]!r} is not the name of a message type: write package/Type")
    return text


def _node_api(value: Value, _caller_id: str) -> ApiUri:
    text = _filled(value)
    return ApiUri(text, parse_node_uri(text))


def _service_api(value: Value, _caller_id: str) -> ApiUri:
    text = _filled(value)
    return ApiUri(text, parse_service_uri(text))


def _parameter_value(value: Value, _caller_id: str) -> Value:
    if value is None:
        raise ProtocolError("must be specified")
    _check_members(value, "")
    return value


def _check_members(value: Value, place: str) -> None:
    """A namespace's members are below it: ROSMaster would read a name like `/a` as the key of another parameter."""
    if not isinstance(value, dict):
        return
    for name, member in value.items():
        if not names.is_relative_member(name):
            where = f"in {place!a} " if place else ""
            raise InvalidNameError(
                f"has a member {where}named {name[:80]!a}, which is no relative name: write 'name' or 'namespace/name'"
            )
        _check_members(member, f"{place}/{name}"[:80])


def _names(value: Value, caller_id: str) -> list[str]:
    if not isinstance(value, list):
        raise ProtocolError(f"must be a list of names, not {_type_name(value)}")
    return [_text(one, caller_id) for one in value]


def _protocols(value: Value, _caller_id: str) -> list[list[Value]]:
    if not isinstance(value, list) or not value:
        raise ProtocolError("must be specified and a list that is not empty")
    protocols = [one for one in value if isinstance(one, list)]
    if len(protocols) != len(value):
        raise ProtocolError("must be a list of protocols, each a list of its name and its parameters")
    return protocols


TOPIC = Parameter("topic", _name, resource=True)
TOPIC_TYPE = Parameter("topic_type", _type)
SERVICE = Parameter("service", _name, resource=True)
NODE = Parameter("node", _name, recorded=True)
CALLER_API = Parameter("caller_api", _node_api)
SERVICE_API = Parameter("service_api", _service_api)
SUBGRAPH = Parameter("subgraph", _subgraph, recorded=True)
KEY = Parameter("key", _key, resource=True, recorded=True)
SEARCH_KEY = Parameter("key", _search_key, recorded=True)
VALUE = Parameter("value", _parameter_value)
MESSAGE = Parameter("msg", _text)
STATE = Parameter("state", _text)
MONITORS = Parameter("monitors", _names)
PROTOCOLS = Parameter("protocols", _protocols)
METHOD = Parameter("method_name", _text)


def canonicalise(
    parameters: Sequence[Parameter[Any]], caller_id: str, values: Sequence[Value]
) -> tuple[object, ...]:
    """The canonical values of a call's parameters. Raises `PeerError` with the parameter's name."""
    check_arity(parameters, values)
    canonical = []
    for parameter, value in zip(parameters, values, strict=True):
        try:
            canonical.append(parameter.canonicalise(value, caller_id))
        except PeerError as error:
            raise type(error)(f"ERROR: parameter [{parameter.name}] {error}") from error
    return tuple(canonical)


def check_arity(parameters: Sequence[Parameter[Any]], values: Sequence[Value]) -> None:
    """Raise `ProtocolError`, with ROSMaster's words, unless there are as many values as the call takes."""
    if len(values) != len(parameters):
        raise ProtocolError("Error: bad call arity")


def _filled(value: Value) -> str:
    if not isinstance(value, str) or not value:
        raise ProtocolError("must be a non-empty string")
    return value


def _type_name(value: Value) -> str:
    return "nothing" if value is None else type(value).__name__
