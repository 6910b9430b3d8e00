"""Define a row of the table of operations: how clients send a request of `channel/admin.py` over REST.

The api's routes, the command line's calls and control's check (`rest_meaning.py`) are derived from the rows.
"""

import functools
import types
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field, replace
from typing import Annotated, Any, NamedTuple, TypeVar, Union, get_args, get_origin

import msgspec

from appliance.channel.answers.token_answers import TokenRole

ANSWER_SECONDS = 15.0
R = TypeVar("R", bound=msgspec.Struct)


class Body(NamedTuple):
    """The name and description of a body that is made of the fields of its request."""

    name: str
    description: str


def parameter(description: str | None = None, *, name: str = "", **bounds: Any) -> msgspec.Meta:
    """Return the rules of a field in the path or the query, where it may have another name."""
    return msgspec.Meta(description=description, extra={"name": name}, **bounds)


def rules_of(kind: object) -> Iterator[msgspec.Meta]:
    """Yield the descriptions and bounds of a field, also those of a value that may be null."""
    for part in get_args(kind):
        if isinstance(part, msgspec.Meta):
            yield part
        elif get_origin(kind) is Annotated or type(None) in get_args(kind):
            yield from rules_of(part)


def extra_of(kind: object, name: str) -> Any:
    return next((rule.extra[name] for rule in rules_of(kind) if rule.extra and name in rule.extra), None)


def plain(kind: object) -> object:
    while True:
        if get_origin(kind) is Annotated:
            kind = get_args(kind)[0]
        elif get_origin(kind) in (Union, types.UnionType) and type(None) in get_args(kind):
            (kind,) = (arm for arm in get_args(kind) if arm is not type(None))
        else:
            return kind


class Versioned(NamedTuple):
    """A resource with an ETag, which a change must name in `If-Match`.

    `where` is the path that returns the ETag. `changed` describes status 412 in the contract.
    """

    what: str
    where: str
    changed: str
    seconds: float = ANSWER_SECONDS


@dataclass(frozen=True)
class Operation:
    """One way to send a request over REST. Without `role`, it needs no token; without `path`, other routes use it.

    A field of the request is sent in the path, in the query, in `If-Match` (`expected`), or otherwise in the body. If
    a class has several of these decorators, the top row is first.
    """

    role: TokenRole | None
    method: str = ""
    path: str = ""
    query: tuple[str, ...] = ()
    # The name in the contract. If several operations have one path, the operation with a name describes the path.
    name: str = ""
    words: str = ""
    tag: str = ""
    status: int = 200
    good: str = "OK"
    problems: Mapping[int, str] = field(default_factory=dict)
    # The body, or its class if it has more than the fields of the request. It may also be sent as `text` (text/plain).
    body: Body | type[msgspec.Struct] | None = None
    text: str = ""
    # Further fields of the body, and fields that the operation implies. Operations with the same path differ in these
    # fields; the first matching operation is used.
    says: Mapping[str, Any] = field(default_factory=dict)
    fixed: Mapping[str, Any] = field(default_factory=dict)
    # The resource that the request changes or reads.
    of: Versioned | None = None
    # The action that operators may only try in a dry run, and the action of each field that only admins may set.
    dry_run: str = ""
    admin_with: Mapping[str, str] = field(default_factory=dict)
    # Fields that the appliance fills in when the client leaves them out.
    filled: tuple[str, ...] = ()
    # The path of a route without a token that asks a request without `path`.
    open_path: str = ""
    # A request without `path` that changes something; it has no bearer.
    changes: bool = False
    # Why the command line sends the request to the admin socket only, and what to do instead.
    machine_only: str = ""
    # The only field of control's answer that REST returns; the others have defaults.
    answer_field: str = ""
    seconds: float = 0.0
    request: Any = None

    def __call__(self, request: type[R]) -> type[R]:
        words, tag = self.words or request.__doc__ or "", self.tag or "".join(self.path.split("/")[2:3])
        of = self.of if self.method != "GET" else None
        seconds = self.seconds or (of.seconds if of is not None else ANSWER_SECONDS)
        row = replace(self, request=request, words=words, tag=tag, seconds=seconds)
        _ROWS[request] = (row, *_ROWS.get(request, ()))
        return request

    @property
    def is_change(self) -> bool:
        return bool(self.path) and self.method != "GET"

    def fields(self) -> Mapping[str, msgspec.structs.FieldInfo]:
        return _fields(self.request)

    def in_body(self) -> list[msgspec.structs.FieldInfo]:
        return [
            one
            for name, one in self.fields().items()
            if one.name not in {"expected", *self.query, *self.fixed} and f"{{{name}}}" not in self.path
        ]

    def least(self, given: Mapping[str, object], *, dry_run: bool = False) -> tuple[TokenRole, str]:
        for name, doing in self.admin_with.items():
            if given.get(name):
                return "admin", f"{doing} is for admins"
        if self.dry_run:
            reason = f"{self.dry_run} is for admins; operators may use dry_run=1"
            return ("operator", "") if dry_run else ("admin", reason)
        return self.role or "viewer", ""


@functools.cache
def _fields(request: type[msgspec.Struct]) -> Mapping[str, msgspec.structs.FieldInfo]:
    return {extra_of(one.type, "name") or one.name: one for one in msgspec.structs.fields(request)}


_ROWS: dict[type, tuple[Operation, ...]] = {}
rest = Operation


def rows() -> dict[type, tuple[Operation, ...]]:
    return _ROWS
