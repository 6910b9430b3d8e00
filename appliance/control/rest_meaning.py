"""Which order an HTTP request means: derived here from the request itself, as the client sent it. Pure.

The api makes an order out of each request for a change. Control derives it again from what the client has signed and
carries it out only when both are the same: an api that fell cannot put another order under a proof.

What a request leaves to the appliance is taken from the api's order, and is nothing but this: the signing request of a
kit whose key the api makes. Everything that a request does not say otherwise has the default that `docs/rest.md` gives.
"""

import json
import re
from collections.abc import Callable, Mapping
from typing import Any
from urllib.parse import parse_qs, unquote

import msgspec

from appliance.channel import admin
from appliance.channel.admin import CHANGES, OPERATIONS, PARAMETERS, Operation
from appliance.channel.messages.api import Asked

_TAG = re.compile(r'"([\x21\x23-\x7e]{1,90})"')
_NO = frozenset({"0", "false", "off", "no", "f", "n"})
_READ: Mapping[str, Callable[[list[str]], Any]] = {
    "confirm_within": lambda said: float(said[-1]),
    **dict.fromkeys(("prune", "force", "shadow"), lambda said: said[-1].lower() not in _NO),
    "names": list,
}


class NoOrderError(ValueError):
    """The request orders nothing; the text says why."""


def meant(asked: Asked, given: admin.RestRequest) -> admin.AdminRequest[Any]:
    """The order that a request means, beside the api's. Raises `NoOrderError`."""
    path, _mark, text = asked.target.partition("?")
    query = parse_qs(text, keep_blank_values=True)
    if query.get("dry_run", ["0"])[-1].lower() not in _NO:
        raise NoOrderError("a dry run orders nothing")
    parts = [unquote(part) for part in path.split("/")]
    try:
        for operation in OPERATIONS:
            named = _named(operation.path.split("/"), parts)
            if operation.request in CHANGES and operation.method == asked.method and named is not None:
                order = _order(operation, named, query, asked, given)
                if order is not None:
                    return order
    except (KeyError, TypeError, ValueError, AttributeError, RecursionError) as error:
        raise NoOrderError(f"the request makes no sense: {type(error).__name__}") from None
    raise NoOrderError("no order is given there")


def _named(template: list[str], parts: list[str]) -> dict[str, str] | None:
    """The fields that the path has; None: it is another's."""
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
    asked: Asked,
    given: admin.RestRequest,
) -> admin.AdminRequest[Any] | None:
    """The order; None: the body is another operation's."""
    fields: dict[str, Any] = {"names": [one]} if (one := named.get("names")) is not None else dict(named)
    fields |= operation.fixed
    for name in operation.query:
        if PARAMETERS.get(name, name) in query:
            fields[name] = _READ[name](query[PARAMETERS.get(name, name)])
    of_body = operation.body()
    if of_body or operation.says:
        body = _body(asked)
        if body.get("request") is None and isinstance(given, admin.HostAdd | admin.HostRenew):
            body["request"] = given.request
        if any(body.get(word, said) != said for word, said in operation.says.items()):
            return None
        if any(field.required and body.get(field.name) is None for field in of_body):
            return None
        fields |= {field.name: body[field.name] for field in of_body if field.name in body}
    for field in msgspec.structs.fields(operation.request):
        if field.name == "expected":
            tag = _tag(asked)
            fields["expected"] = int(tag) if tag is not None and field.type == int | None else tag
    return operation.request(**fields)


def _body(asked: Asked) -> dict[str, Any]:
    kind = asked.content_type.partition(";")[0].strip().lower()
    if kind == "text/plain":
        return {"text": asked.body.decode("utf-8")}
    body = json.loads(asked.body) if asked.body else {}
    if not isinstance(body, dict):
        raise NoOrderError("the body is no object")
    return body


def _tag(asked: Asked) -> str | None:
    """What `If-Match` names; None for `*`."""
    given = asked.if_match.strip()
    if given == "*":
        return None
    found = _TAG.fullmatch(given)
    if found is None:
        raise NoOrderError("If-Match names nothing")
    return found[1]
