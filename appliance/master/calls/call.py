"""Define a row of a table of calls, and an attempt to make such a call.

A call is decided by canonical values: names are resolved as in the ROS master, including the caller's, because some
client libraries send `//name`.
"""

import enum
from collections.abc import Awaitable, Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, Generic, NamedTuple, TypeVar, cast, overload

from appliance.master.graph.registry import Incarnation, Kind
from appliance.policy.commands import ALIASES, CALLS, PolicyCall
from appliance.policy.model import Category, Decision, Request, text_for_caller
from appliance.policy.rights import request_of
from appliance.rpc.server import Peer
from appliance.telemetry.audit_trail import Asker
from roswire import names
from roswire.errors import InvalidNameError, PeerError, ProtocolError
from roswire.names import canonical_caller_id, canonical_tool_id
from roswire.uris import NodeUri, parse_node_uri, parse_service_uri
from roswire.xmlrpc import Value

T = TypeVar("T")


class NotServedError(Exception):
    """The appliance does not carry out a call that the policy allows; the message says why."""


@dataclass(frozen=True, slots=True)
class ApiUri:
    """A URI as received, and parsed."""

    text: str
    uri: NodeUri


class Caller(NamedTuple):
    """The peer, and the `caller_id` that the peer claims.

    `own` marks the appliance's own nodes, which have a separate listener. `target` is the incarnation whose proxy
    endpoint is called. `in_multicall`: the call is a part of a multicall.
    """

    peer: Peer
    caller_id: str
    arrived: int
    own: bool = False
    target: Incarnation | None = None
    in_multicall: bool = False

    @property
    def asker(self) -> Asker:
        return Asker(
            self.peer.text, self.caller_id, self.arrived, None if self.target is None else self.target.name
        )


@dataclass(frozen=True, slots=True)
class CallParameter(Generic[T]):
    """A parameter of a call, with the conversion to its canonical value.

    The `recorded` parameters are resolved names. The record of a command includes them, and in a call with a kind,
    the first of them is the resource.
    """

    name: str
    canonicalise: Callable[[Value, str], T]
    recorded: bool = False


def _text(value: Value, _caller_id: str) -> str:
    if not isinstance(value, str):
        raise ProtocolError(f"must be a string, not {_type_name(value)}")
    return value


def _name(value: Value, caller_id: str) -> str:
    return names.resolve(_fill(value), caller_id)


def _subgraph(value: Value, caller_id: str) -> str:
    text = _text(value, caller_id)
    return names.resolve_namespace(text, caller_id) if text else ""


def _key(value: Value, caller_id: str) -> str:
    return names.resolve_parameter(_fill(value), caller_id)


def _search_key(value: Value, caller_id: str) -> str:
    text = _fill(value)
    if text.startswith("~"):
        raise InvalidNameError(f"{text!r} is private: searchParam takes a relative or global name")
    names.resolve_parameter(text, caller_id)
    return text


def _type(value: Value, _caller_id: str) -> str:
    text = _fill(value)
    if not names.is_valid_type_name(text):
        raise InvalidNameError(f"{text[:80]!r} is not the name of a message type: write package/Type")
    return text


def _node_api(value: Value, _caller_id: str) -> ApiUri:
    text = _fill(value)
    return ApiUri(text, parse_node_uri(text))


def _service_api(value: Value, _caller_id: str) -> ApiUri:
    text = _fill(value)
    return ApiUri(text, parse_service_uri(text))


def _parameter_value(value: Value, _caller_id: str) -> Value:
    if value is None:
        raise ProtocolError("must be specified")
    _check_members(value, "")
    return value


def _check_members(value: Value, place: str) -> None:
    """Raise `InvalidNameError` for a member name such as `/a`, which means another parameter to the ROS master."""
    if not isinstance(value, dict):
        return
    for name, member in value.items():
        if not names.is_relative_member(name):
            where = f"in {place!a} " if place else ""
            raise InvalidNameError(
                f"has a member {where}named {name[:80]!a}, which is not a relative name: "
                "write 'name' or 'namespace/name'"
            )
        _check_members(member, f"{place}/{name}"[:80])


def _names(value: Value, caller_id: str) -> list[str]:
    if not isinstance(value, list):
        raise ProtocolError(f"must be a list of names, not {_type_name(value)}")
    return [_text(item, caller_id) for item in value]


def _protocols(value: Value, _caller_id: str) -> list[list[Value]]:
    if not isinstance(value, list) or not value:
        raise ProtocolError("must be specified and a list that is not empty")
    protocols = [protocol for protocol in value if isinstance(protocol, list)]
    if len(protocols) != len(value):
        raise ProtocolError("must be a list of protocols, each a list of its name and its parameters")
    return protocols


TOPIC = CallParameter("topic", _name, recorded=True)
TOPIC_TYPE = CallParameter("topic_type", _type)
SERVICE = CallParameter("service", _name, recorded=True)
NODE = CallParameter("node", _name, recorded=True)
CALLER_API = CallParameter("caller_api", _node_api)
SERVICE_API = CallParameter("service_api", _service_api)
SUBGRAPH = CallParameter("subgraph", _subgraph, recorded=True)
KEY = CallParameter("key", _key, recorded=True)
SEARCH_KEY = CallParameter("key", _search_key, recorded=True)
VALUE = CallParameter("value", _parameter_value)
MESSAGE = CallParameter("msg", _text)
STATE = CallParameter("state", _text)
MONITORS = CallParameter("monitors", _names)
PROTOCOLS = CallParameter("protocols", _protocols)
METHOD = CallParameter("method_name", _text)


def canonicalise(
    parameters: Sequence[CallParameter[object]], caller_id: str, values: Sequence[Value]
) -> tuple[object, ...]:
    canonical = []
    for parameter, value in zip(parameters, values, strict=True):
        try:
            canonical.append(parameter.canonicalise(value, caller_id))
        except PeerError as error:
            raise type(error)(f"ERROR: parameter [{parameter.name}] {error}") from error
    return tuple(canonical)


def check_arity(parameters: Sequence[CallParameter[object]], values: Sequence[Value]) -> None:
    if len(values) != len(parameters):
        raise ProtocolError("Error: bad call arity")


def _fill(value: Value) -> str:
    if not isinstance(value, str) or not value:
        raise ProtocolError("must be a non-empty string")
    return value


def _type_name(value: Value) -> str:
    return "nothing" if value is None else type(value).__name__


_CLAIM_SHOWN = 1024  # the most recorded characters of a caller_id that is not a valid name

S = TypeVar("S")
A = TypeVar("A")
B = TypeVar("B")
C = TypeVar("C")


class CallVerb(enum.StrEnum):
    """The effect of a call on its resource."""

    REGISTER = "register"  # the node gets the resource
    UNREGISTER = "unregister"  # the node gives up the resource
    CONNECT = "connect"  # the caller gets an address, and may then connect
    READ = "read"  # nothing changes; an empty caller_id is valid, and the audit log counts repetitions
    WRITE = "write"  # a ROS parameter is set to the value in the call, or deleted if there is no value
    DO = "do"  # any other effect


@dataclass(frozen=True, slots=True)
class Method(Generic[S]):
    """A method of `S` that carries out a call, and the parameters of the call after the caller_id."""

    perform: Callable[..., Awaitable[Value]]
    parameters: tuple[CallParameter[object], ...]


@overload
def method(perform: Callable[[S, Caller], Awaitable[Value]], /) -> Method[S]: ...
@overload
def method(perform: Callable[[S, Caller, A], Awaitable[Value]], a: CallParameter[A], /) -> Method[S]: ...
@overload
def method(
    perform: Callable[[S, Caller, A, B], Awaitable[Value]], a: CallParameter[A], b: CallParameter[B], /
) -> Method[S]: ...
@overload
def method(
    perform: Callable[[S, Caller, A, B, C], Awaitable[Value]],
    a: CallParameter[A],
    b: CallParameter[B],
    c: CallParameter[C],
    /,
) -> Method[S]: ...
def method(perform: Callable[..., Awaitable[Value]], /, *parameters: CallParameter[Any]) -> Method[Any]:
    return Method(perform, parameters)


@dataclass(frozen=True, slots=True)
class RosCall(Generic[S]):
    """One row of a table of calls. The fields below `in_run` are derived from the others and from the policy's row.

    method      carries out the call; `system.methodHelp` returns its docstring
    kind        the kind of the resource (None: the call is decided by its name alone)
    denial      the value in a denial, of the type of the call's result, which client libraries check
    command     the name of the call in the policy, if `policy/commands` does not derive the name
    tells       the answer is the value of the ROS parameter, which may be a large tree
    in_run      adjacent calls with this flag in a multicall are carried out together
    """

    name: str
    method: Method[S]
    verb: CallVerb
    kind: Kind | None = None
    denial: Value = 0
    command: str | None = None
    tells: bool = False
    in_run: bool = False
    resource: int | None = field(init=False)  # the index of the parameter that is the call's resource
    api: int | None = field(init=False)  # the index of the caller's own URI
    policy_name: str = field(init=False)
    row: PolicyCall = field(init=False)  # the call's row in the policy

    def __post_init__(self) -> None:
        parameters = self.method.parameters
        recorded = [place for place, parameter in enumerate(parameters) if parameter.recorded]
        policy_name = self.command or ALIASES.get(self.name, self.name)
        derived = {
            "resource": None if self.kind is None else recorded[0],
            "api": parameters.index(CALLER_API) if CALLER_API in parameters else None,
            "policy_name": policy_name,
            "row": CALLS[policy_name],
        }
        for field_name, value in derived.items():
            object.__setattr__(self, field_name, value)

    def attempt(self, caller: Caller, params: Sequence[Value]) -> "Attempt":
        if self.row.wire:  # a call of the XML-RPC server has no caller_id
            check_arity(self.method.parameters, params)
            return Attempt(caller, self, canonicalise(self.method.parameters, "", params))
        if not params:
            raise ProtocolError("missing required caller_id parameter")
        given = params[1:]
        check_arity(self.method.parameters, given)
        caller_id = params[0]
        if not isinstance(caller_id, str):
            raise ProtocolError("caller_id must be a string")
        if self.row.node:
            caller_id = canonical_caller_id(caller_id)
        elif caller_id or self.verb not in {CallVerb.READ, CallVerb.CONNECT}:
            caller_id = canonical_tool_id(caller_id)
        arguments = canonicalise(self.method.parameters, caller_id, given)
        return Attempt(caller._replace(caller_id=caller_id), self, arguments)


@dataclass(frozen=True, slots=True)
class Attempt:
    """A valid call, with canonical arguments in the order of its row. `api` is the URI of the caller."""

    caller: Caller
    call: RosCall[Any]
    arguments: tuple[object, ...]
    resource: str = field(init=False)
    api: ApiUri | None = field(init=False)
    request: Request = field(init=False)

    def __post_init__(self) -> None:
        caller, call = self.caller, self.call
        resource = "" if call.resource is None else str(self.arguments[call.resource])
        object.__setattr__(self, "api", None if call.api is None else self.arguments[call.api])
        request = request_of(call.policy_name, caller.peer.host, caller.caller_id, resource)
        object.__setattr__(self, "resource", resource)
        object.__setattr__(self, "request", request)

    @property
    def value(self) -> Value:
        brings = self.call.verb is CallVerb.WRITE and len(self.arguments) > 1
        return cast(Value, self.arguments[1]) if brings else None

    @property
    def about(self) -> dict[str, str]:
        """Return the recorded parameters of a command; its request has only the call's name."""
        if self.call.row.category is not Category.COMMAND:
            return {}
        return {
            parameter.name: str(value)
            for parameter, value in zip(self.call.method.parameters, self.arguments, strict=True)
            if parameter.recorded
        }


class ServedCall(NamedTuple):
    """A row, and the object whose method carries out the call."""

    call: RosCall[Any]
    part: Any


Table = Mapping[str, ServedCall]


def served_calls(calls: Iterable[RosCall[S]], part: S) -> dict[str, ServedCall]:
    return {call.name: ServedCall(call, part) for call in calls}


def denial_text(decision: Decision, record: str, tell: str) -> str:
    return with_record(text_for_caller(decision, tell), record)


def with_record(text: str, record: str) -> str:
    return f"{text} [{record}]" if record else text


def claimed_name(params: Sequence[Value]) -> str:
    return params[0][:_CLAIM_SHOWN] if params and isinstance(params[0], str) else ""
