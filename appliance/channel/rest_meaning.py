"""Convert HTTP requests to orders, and orders to HTTP requests, by the table of operations.

Control derives the api's order again from the client's request and carries it out only if both are equal, so a
compromised api cannot use a proof for another order. It may only fill in the fields in `Operation.filled`.
"""

import json
import re
from collections.abc import Mapping
from typing import NamedTuple, get_origin
from urllib.parse import parse_qs, quote, unquote, urlencode

import msgspec

from appliance.base.timestamps import parse_date
from appliance.base.validation_messages import refused_field
from appliance.channel.admin import AdminRequest, operation_of
from appliance.channel.messages.api import ClientRequest
from appliance.channel.operations import OPERATIONS
from appliance.channel.rest_bodies import DATED
from appliance.channel.rest_operation import Operation, extra_of, plain

_TAG = re.compile(r'"([\x21\x23-\x7e]{1,90})"')
_REVISION = re.compile(r"[0-9]{1,18}")
_NO = frozenset({"", "0", "false", "off", "no", "f", "n"})
_SECOND = 1_000_000_000


class NoOrderError(ValueError):
    """A request cannot be converted to an order; the message gives the reason."""


class BadTagError(NoOrderError):
    """`If-Match` does not contain an ETag of the resource that the request changes."""


class RestCall(NamedTuple):
    """An order as an HTTP request; `match`: `If-Match: *`, so it changes any revision in force."""

    method: str
    target: str
    body: dict[str, object] | None
    match: bool


def is_dry_run(query: str) -> bool:
    return parse_qs(query, keep_blank_values=True).get("dry_run", ["0"])[-1].lower() not in _NO


def order_of(asked: ClientRequest, *, dry_run: bool = False) -> AdminRequest[object]:
    """Return the order in a request; with `dry_run`, it must be a dry run. Raises `NoOrderError`."""
    path, _mark, text = asked.target.partition("?")
    if is_dry_run(text) is not dry_run:
        raise NoOrderError("a dry run changes nothing")
    parts = [unquote(part) for part in path.split("/")]
    try:
        query = parse_qs(text, keep_blank_values=True)
        for operation in OPERATIONS:
            named = _named(operation.path, parts)
            if operation.method == asked.method and named is not None:
                order = _order(operation, named, query, asked, dry_run=dry_run)
                if order is not None:
                    return order
    except NoOrderError:
        raise
    except msgspec.ValidationError as error:
        where, said = refused_field(error)
        raise NoOrderError(f"{where.lstrip('.')}: {said}") from None
    except (KeyError, TypeError, ValueError, AttributeError, RecursionError) as error:
        raise NoOrderError(f"the request is invalid: {type(error).__name__}") from None
    raise NoOrderError("this path takes no orders")


def filled_in(order: AdminRequest[object], given: AdminRequest[object]) -> AdminRequest[object]:
    operation = operation_of(order)
    if operation is None or type(order) is not type(given):
        return order
    ours, theirs = msgspec.structs.asdict(order), msgspec.structs.asdict(given)
    left = {name: theirs[name] for name in operation.filled if not ours[name]}
    return msgspec.structs.replace(order, **left)


def call_of(order: AdminRequest[object], operation: Operation) -> RestCall:
    values = msgspec.structs.asdict(order)
    path, query = operation.path, []
    for name, field in operation.fields().items():
        value = values[field.name]
        if f"{{{name}}}" in path:
            (text,) = value if isinstance(value, list) else (value,)
            path = path.replace(f"{{{name}}}", quote(str(text), safe=""))
        elif field.name in operation.query and value != field.default:
            query += [(name, _written(one)) for one in (value if isinstance(value, list) else [value])]
    body = {**operation.says, **{field.name: values[field.name] for field in operation.in_body()}}
    target = f"{path}?{urlencode(query)}" if query else path
    return RestCall(operation.method, target, body or None, operation.is_change and "expected" in values)


def _written(value: object) -> str:
    return str(int(value)) if isinstance(value, bool) else str(value)


def _named(path: str, parts: list[str]) -> dict[str, str] | None:
    template = path.split("/")
    if len(template) != len(parts):
        return None
    both = list(zip(template, parts, strict=True))
    if any(word != part for word, part in both if not word.startswith("{")):
        return None
    return {word.strip("{}"): part for word, part in both if word.startswith("{")}


def _order(
    operation: Operation,
    named: Mapping[str, str],
    query: Mapping[str, list[str]],
    asked: ClientRequest,
    *,
    dry_run: bool,
) -> AdminRequest[object] | None:
    fields: dict[str, object] = dict(operation.fixed)
    for name, field in operation.fields().items():
        if name in named:
            fields[field.name] = _read(field.type, [named[name]])
        elif field.name in operation.query and name in query:
            fields[field.name] = _read(field.type, query[name])
        elif field.name == "expected" and not (dry_run and not asked.if_match):
            tag = _tag(operation, asked.if_match)
            fields["expected"] = int(tag) if tag is not None and plain(field.type) is int else tag
    in_body = operation.in_body()
    if in_body or operation.says:
        body = _body(asked)
        body |= {name: "" for name in operation.filled if body.get(name) is None}
        if any(body.get(word, said) != said for word, said in operation.says.items()):
            return None
        if any(field.required and body.get(field.name) is None for field in in_body):
            return None
        fields |= {field.name: _moment(field, body[field.name]) for field in in_body if field.name in body}
    order: AdminRequest[object] = msgspec.convert(fields, operation.request)
    return order


def _read(kind: object, given: list[str]) -> object:
    kind = plain(kind)
    if get_origin(kind) is list:
        return given
    if kind is bool:
        return given[-1].lower() not in _NO
    return kind(given[-1]) if kind in (int, float) else given[-1]


def _moment(field: msgspec.structs.FieldInfo, value: object) -> object:
    if not isinstance(value, str) or not extra_of(field.type, DATED):
        return value
    try:
        moment = parse_date(value)
    except ValueError:
        raise NoOrderError(
            f"body.{field.name}: {value[:80]!r} is not a date: write 2026-03-01T12:00:00Z"
        ) from None
    return moment if plain(field.type) is int else moment / _SECOND


def _body(asked: ClientRequest) -> dict[str, object]:
    kind = asked.content_type.partition(";")[0].strip().lower()
    if kind == "text/plain":
        return {"text": asked.body.decode("utf-8")}
    body = json.loads(asked.body) if asked.body else {}
    if not isinstance(body, dict):
        raise NoOrderError("the body is not an object")
    return body


def _tag(operation: Operation, if_match: str) -> str | None:
    """Return the tag in `If-Match`, or None for `*`. Raises `BadTagError`."""
    assert operation.of is not None  # noqa: S101  a request with `expected` changes something that has an ETag
    given = if_match.strip()
    if given == "*":
        return None
    match = _TAG.fullmatch(given)
    numbered = plain(operation.fields()["expected"].type) is int
    if match is None or (numbered and not _REVISION.fullmatch(match[1])):
        raise BadTagError(
            f'{if_match[:80]!r} is not an ETag of {operation.of.where}: send the one that GET returns, as in "7"'
        )
    return match[1]
