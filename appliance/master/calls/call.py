"""The nouns of RVMaster: a row of a table of calls, and one attempt to make such a call.

`table.py` has the Master API's rows, `node_calls.py` those of the outer face. A row names a method of the part that
carries the call out; mypy holds the method's parameters against the row's.

Each parameter is turned into its one canonical value before a decision: a name becomes what ROSMaster would resolve it
to; a URI is parsed; anything else is a `PeerError` that names the parameter, as ROSMaster's own validators would.
"""

import enum
from collections.abc import Awaitable, Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, Generic, NamedTuple, TypeVar, cast, overload

from appliance.master.caller import ApiUri, Caller
from appliance.master.graph.registry import Kind
from appliance.policy.model import Category, Decision, Request, told_of
from appliance.policy.rights import category_of, request_of, touch_of
from roswire import names
from roswire.errors import InvalidNameError, PeerError, ProtocolError
from roswire.names import check_caller_id, check_tool_id
from roswire.uris import parse_node_uri, parse_service_uri
from roswire.xmlrpc import Value

T = TypeVar("T")


@dataclass(frozen=True, slots=True)
class Parameter(Generic[T]):
    """One parameter of a call: its name in the ROS documentation, and how its value is made a canonical one.

    `recorded`: it is a resolved name, short, and what a reviewer asks for: the record of a command has it, and a call
    with a kind is about the first of them.
    """

    name: str
    canonicalise: Callable[[Value, str], T]
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
    return [_text(item, caller_id) for item in value]


def _protocols(value: Value, _caller_id: str) -> list[list[Value]]:
    if not isinstance(value, list) or not value:
        raise ProtocolError("must be specified and a list that is not empty")
    protocols = [protocol for protocol in value if isinstance(protocol, list)]
    if len(protocols) != len(value):
        raise ProtocolError("must be a list of protocols, each a list of its name and its parameters")
    return protocols


TOPIC = Parameter("topic", _name, recorded=True)
TOPIC_TYPE = Parameter("topic_type", _type)
SERVICE = Parameter("service", _name, recorded=True)
NODE = Parameter("node", _name, recorded=True)
CALLER_API = Parameter("caller_api", _node_api)
SERVICE_API = Parameter("service_api", _service_api)
SUBGRAPH = Parameter("subgraph", _subgraph, recorded=True)
KEY = Parameter("key", _key, recorded=True)
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


_CLAIM_SHOWN = 1024  # characters of a caller_id that is no name

S = TypeVar("S")
A = TypeVar("A")
B = TypeVar("B")
C = TypeVar("C")


class Identity(enum.Enum):
    """What a call claims by its `caller_id`, and so what is checked of it."""

    NODE = "node"  # makes the node part of the graph: [Nodes] must grant the name, nobody else may hold it
    FREE = "free"  # nobody else may hold the name; it need not be a node's
    NOBODY = "nobody"  # the call has no caller_id


class Verb(enum.StrEnum):
    """What a call does with what it is about."""

    REGISTER = "register"  # a node has it from then on
    UNREGISTER = "unregister"  # a node gives it up
    CONNECT = "connect"  # the caller learns where to connect, and may from then on
    READ = "read"  # nothing changes: an empty caller_id will do, and repetitions are counted in the audit log
    WRITE = "write"  # a ROS parameter, which has the value that the call brings, or is gone if it brings none
    DO = "do"  # anything else


@dataclass(frozen=True, slots=True)
class Method(Generic[S]):
    """A method of `S` that carries a call out, and the parameters of the call that follow the caller_id."""

    perform: Callable[..., Awaitable[Value]]
    parameters: tuple[Parameter[Any], ...]


@overload
def method(perform: Callable[[S, Caller], Awaitable[Value]], /) -> Method[S]: ...
@overload
def method(perform: Callable[[S, Caller, A], Awaitable[Value]], a: Parameter[A], /) -> Method[S]: ...
@overload
def method(
    perform: Callable[[S, Caller, A, B], Awaitable[Value]], a: Parameter[A], b: Parameter[B], /
) -> Method[S]: ...
@overload
def method(
    perform: Callable[[S, Caller, A, B, C], Awaitable[Value]],
    a: Parameter[A],
    b: Parameter[B],
    c: Parameter[C],
    /,
) -> Method[S]: ...
def method(perform: Callable[..., Awaitable[Value]], /, *parameters: Parameter[Any]) -> Method[Any]:
    """The method, and which parameter of the call each of its own is."""
    return Method(perform, parameters)


@dataclass(frozen=True, slots=True)
class Call(Generic[S]):
    """One row of a table of calls.

    method      what carries it out, and its parameters; the first line of its docstring is `system.methodHelp`
    verb        what it does, with a thing of this
    kind        (None: it is decided by its name alone, whatever its parameters name)
    denial      the value of a denied answer: of the type the call returns, so that no client library stumbles over it
    identity    what is checked of the caller_id
    command     the name that the policy knows it by, where that is another (`policy/rights` says what it needs)
    tells       the answer is the value of the ROS parameter, which may be a large tree
    small       parameters and answer are a few names: calls of the same moment travel to ROSMaster as one
    in_run      in a multicall it is decided, recorded and carried out together with its neighbours that are, too
    """

    name: str
    method: Method[S]
    verb: Verb
    kind: Kind | None = None
    denial: Value = 0
    identity: Identity = Identity.FREE
    command: str | None = None
    tells: bool = False
    small: bool = False
    in_run: bool = False
    resource: int | None = field(init=False)  # which parameter names what it is about
    api: int | None = field(init=False)  # which is the caller's own URI
    policy_name: str = field(init=False)  # the name that the policy knows it by
    category: Category = field(init=False)  # what kind of thing it is decided and recorded as

    def __post_init__(self) -> None:
        parameters = self.method.parameters
        places = [place for place, parameter in enumerate(parameters) if parameter.recorded]
        own = [place for place, parameter in enumerate(parameters) if parameter.name == "caller_api"]
        object.__setattr__(self, "resource", None if self.kind is None else places[0])
        object.__setattr__(self, "api", own[0] if own else None)
        object.__setattr__(self, "policy_name", self.command or self.name)
        object.__setattr__(self, "category", category_of(self.policy_name))

    @property
    def touches(self) -> Category | None:
        """Whether it reads or writes the ROS parameter that it is about."""
        return touch_of(self.policy_name)

    def attempt(self, caller: Caller, params: Sequence[Value]) -> "Attempt":
        """The call with canonical arguments, and the caller with the name that it claims. Raises `PeerError`."""
        if self.identity is Identity.NOBODY:
            return Attempt(caller, self, canonicalise(self.method.parameters, "", params))
        if not params:
            raise ProtocolError("missing required caller_id parameter")
        given = params[1:]
        check_arity(self.method.parameters, given)
        caller_id = params[0]
        if not isinstance(caller_id, str):
            raise ProtocolError("caller_id must be a string")
        if self.identity is Identity.NODE:
            check_caller_id(caller_id)
        elif caller_id or self.verb not in {Verb.READ, Verb.CONNECT}:
            check_tool_id(caller_id)
        arguments = canonicalise(self.method.parameters, caller_id, given)
        return Attempt(caller.as_named(caller_id), self, arguments)


@dataclass(frozen=True, slots=True)
class Attempt:
    """A call that was understood: who makes it, its row, and its arguments, canonical and as the row has them.

    `resource` is the topic, service or ROS parameter that it is about, empty when it is about none; `request` what it
    is decided and recorded as.
    """

    caller: Caller
    call: Call[Any]
    arguments: tuple[object, ...]
    resource: str = field(init=False)
    request: Request = field(init=False)

    def __post_init__(self) -> None:
        caller, call = self.caller, self.call
        resource = "" if call.resource is None else str(self.arguments[call.resource])
        request = request_of(call.policy_name, caller.peer.host, caller.caller_id, resource)
        object.__setattr__(self, "resource", resource)
        object.__setattr__(self, "request", request)

    @property
    def api(self) -> ApiUri | None:
        """The URI that the caller gives for itself."""
        return None if self.call.api is None else cast(ApiUri, self.arguments[self.call.api])

    @property
    def value(self) -> Value:
        """The value that a call which writes a ROS parameter brings; None for one that takes it away."""
        brings = self.call.verb is Verb.WRITE and len(self.arguments) > 1
        return cast(Value, self.arguments[1]) if brings else None

    @property
    def about(self) -> dict[str, str]:
        """What a command is about (a parameter's key, a node's name), for the record: its resource is the command."""
        if self.call.category is not Category.COMMAND:
            return {}
        return {
            parameter.name: str(value)
            for parameter, value in zip(self.call.method.parameters, self.arguments, strict=True)
            if parameter.recorded
        }


class Served(NamedTuple):
    """A row that is served, and the part whose method carries it out."""

    call: Call[Any]
    part: Any


Table = Mapping[str, Served]
"""What a listener serves, by the call's name."""


def served(calls: Iterable[Call[S]], part: S) -> dict[str, Served]:
    """These calls, carried out by this part."""
    return {call.name: Served(call, part) for call in calls}


def denial_text(decision: Decision, record: str, tell: str) -> str:
    """What a denied caller is told: as much of the reason as the policy lets be told, and the record's id."""
    return with_record(told_of(decision, tell), record)


def with_record(text: str, record: str) -> str:
    """What is told of a refusal that has this record; it has none when it is one of many that are counted."""
    return f"{text} [{record}]" if record else text


def claimed_name(params: Sequence[Value]) -> str:
    """Whom a call that is not understood says it is from, for the record."""
    return params[0][:_CLAIM_SHOWN] if params and isinstance(params[0], str) else ""
