"""Which order an HTTP request means: derived here from the request itself, as the client sent it. Pure.

The api makes an order out of each request for a change. Control derives it again from what the client has signed and
carries it out only when both are the same: an api that fell cannot put another order under a proof.

What a request leaves to the appliance is taken from the api's order, and is nothing but this: the signing request of a
kit whose key the api makes. Everything that a request does not say otherwise has the default that `docs/rest.md` gives.
"""

import json
import re
from collections.abc import Mapping
from typing import Any
from urllib.parse import parse_qsl, unquote

from appliance.channel import admin
from appliance.channel.messages import Asked

_TAG = re.compile(r'"([\x21\x23-\x7e]{1,90})"')
_NO = frozenset({"0", "false", "off", "no", "f", "n"})
_LOCAL_PORTS, _DAYS, _TOKEN_SECONDS = "32768-60999", 90, 3600


class NoOrderError(ValueError):
    """The request orders nothing; the text says why."""


def meant(asked: Asked, given: admin.RestRequest) -> admin.RestRequest:
    """The order that a request means, beside the api's. Raises `NoOrderError`."""
    path, _mark, query = asked.target.partition("?")
    fields = dict(parse_qsl(query, keep_blank_values=True))
    if fields.get("dry_run", "0").lower() not in _NO:
        raise NoOrderError("a dry run orders nothing")
    parts = [unquote(part) for part in path.split("/")]
    try:
        match parts:
            case ["", "v1", "policy", *rest]:
                return _policy(asked, rest, fields)
            case ["", "v1", "monitors", *rest]:
                return _monitors(asked, rest, query, fields)
            case ["", "v1", "hosts", *rest]:
                return _hosts(asked, rest, given)
            case ["", "v1", "tokens", name] if asked.method == "DELETE":
                return admin.TokenRevoke(name)
    except (KeyError, TypeError, ValueError, AttributeError, RecursionError) as error:
        raise NoOrderError(f"the request makes no sense: {type(error).__name__}") from None
    raise NoOrderError("no order is given there")


def _policy(asked: Asked, rest: list[str], fields: Mapping[str, str]) -> admin.RestRequest:
    expected = _revision(asked)
    within = float(fields["confirm_within"]) if "confirm_within" in fields else None
    match asked.method, rest:
        case "POST", []:
            body = _body(asked)
            return admin.PolicyLoad(body["text"], body.get("note", ""), within, expected)
        case "POST", ["rollback"]:
            return admin.PolicyRollback(_body(asked).get("revision"), expected)
        case "POST", ["reload"]:
            return admin.PolicyReload(within, expected)
        case "POST", ["confirm"]:
            return admin.PolicyConfirm(expected)
    raise NoOrderError("no order about the policy is given there")


def _monitors(  # noqa: PLR0911  one for each route
    asked: Asked, rest: list[str], query: str, fields: Mapping[str, str]
) -> admin.RestRequest:
    expected = _tag(asked)
    match asked.method, rest:
        case "POST", []:
            body = _body(asked)
            return admin.MonitorLoad(
                body["files"], body.get("definitions", {}), body.get("note", ""), expected
            )
        case "POST", ["reload"]:
            return admin.MonitorReload(expected, fields.get("prune", "0").lower() not in _NO)
        case "PUT", [name]:
            body = _body(asked)
            return admin.MonitorReplace(
                name, body["text"], body.get("definitions", {}), body.get("note", ""), expected
            )
        case "DELETE", []:
            names = [text for field, text in parse_qsl(query, keep_blank_values=True) if field == "name"]
            return admin.MonitorRemove(names, expected)
        case "DELETE", [name]:
            return admin.MonitorRemove([name], expected)
        case "PATCH", ([] | [_]):
            body = _body(asked)
            names = rest or body["names"]
            if body.get("enabled") is None:
                return admin.MonitorResume(names, expected)
            return admin.MonitorSwitch(names, body["enabled"], expected)
    raise NoOrderError("no order about monitors is given there")


def _hosts(  # noqa: PLR0911  one for each route
    asked: Asked, rest: list[str], given: admin.RestRequest
) -> admin.RestRequest:
    expected = _revision(asked)
    match asked.method, rest:
        case "POST", ["reload"]:
            return admin.HostsReload(expected)
        case "DELETE", [name]:
            return admin.HostRevoke(name, expected)
        case "PUT", [name, "ports"]:
            body = _body(asked)
            return admin.HostPorts(name, body["state"], body.get("open", []), body.get("checked"), expected)
        case "POST", []:
            body = _body(asked)
            if body.get("how", "token") == "token":
                return _host_token(body["name"], body, expected, new=True)
            days, address = body.get("days", _DAYS), body.get("address")
            return admin.HostAdd(body["name"], _signing_request(body, given), days, address, expected)
        case "POST", [name, "token"]:
            return _host_token(name, _body(asked), expected, new=False)
        case "POST", [name, "kit"]:
            body = _body(asked)
            return admin.HostRenew(name, _signing_request(body, given), body.get("days", _DAYS), expected)
    raise NoOrderError("no order about hosts is given there")


def _host_token(name: str, body: Mapping[str, Any], expected: int | None, *, new: bool) -> admin.HostToken:
    kit = {
        "endpoint": body.get("endpoint") or "",
        "ports": body.get("ports", _LOCAL_PORTS),
        "open": ",".join(body.get("open", [])),
    }
    seconds, days = body.get("token_seconds", _TOKEN_SECONDS), body.get("days", _DAYS)
    return admin.HostToken(name, kit, seconds, days, body.get("address"), expected, new)


def _signing_request(body: Mapping[str, Any], given: admin.RestRequest) -> str:
    """The host's own, or that of the key which the api makes for a kit."""
    if body.get("request") is not None:
        return str(body["request"])
    return given.request if isinstance(given, admin.HostAdd | admin.HostRenew) else ""


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


def _revision(asked: Asked) -> int | None:
    tag = _tag(asked)
    return None if tag is None else int(tag)
