"""Parse the beginning of a request's body, for the record of a denial. No I/O.

The beginning is untrusted and a few KiB long. A complete known call is recorded like a decided one.
"""

import re
from collections.abc import Mapping
from typing import Any, NamedTuple

from appliance.master.calls.call import Caller, RosCall, claimed_name
from appliance.master.calls.call_table import MASTER_CALLS
from appliance.master.calls.multicall import MULTICALL
from appliance.master.calls.node_calls import NODE_CALLS
from appliance.policy.model import Category
from appliance.rpc.server import Peer
from roswire.errors import PeerError
from roswire.xmlrpc import Value, XmlRpcLimits, parse_call

_CALLS: Mapping[str, RosCall[Any]] = {**NODE_CALLS, **MASTER_CALLS}
_LIMITS = XmlRpcLimits(body=8192, elements=256, depth=16, string=4096, parts=64)
_UNKNOWN = "unknown"
_LONGEST = 200
_MAX_PARTS = 8
_BEGINNING = 4096  # the number of bytes that are searched for the name of a method
_METHOD = re.compile(rb"<methodName>\s*+([^<>&\s]{1,128}+)\s*+</methodName>")


class PeekedRequest(NamedTuple):
    """The readable part of a request."""

    category: Category
    resource: str
    caller_id: str | None
    about: dict[str, str]


def asked_for(peer: Peer, beginning: bytes) -> PeekedRequest:
    try:
        call = parse_call(beginning, _LIMITS)
    except PeerError:
        return _only_named(method_named(beginning), None)
    row = _CALLS.get(call.method)
    if row is None:
        about = {"parts": _parts(call.params)} if call.method == MULTICALL else {}
        return _only_named(call.method, None, about)
    try:
        attempt = row.attempt(Caller(peer, "", 0), call.params)
    except PeerError:
        return _only_named(call.method, claimed_name(call.params))
    request = attempt.request
    about = {"call": row.name, **attempt.about}
    return PeekedRequest(request.category, request.resource[:_LONGEST], request.caller_id, about)


def _only_named(method: str, caller_id: str | None, about: dict[str, str] | None = None) -> PeekedRequest:
    known = method if method in _CALLS or method == MULTICALL else _UNKNOWN
    return PeekedRequest(Category.COMMAND, method[:_LONGEST], caller_id, {"call": known, **(about or {})})


def _parts(params: tuple[Value, ...]) -> str:
    parts = params[0] if params and isinstance(params[0], list) else []
    names = [str(part.get("methodName"))[:_LONGEST] for part in parts if isinstance(part, dict)]
    more = f" and {len(names) - _MAX_PARTS} more" if len(names) > _MAX_PARTS else ""
    return ", ".join(names[:_MAX_PARTS]) + more


def method_named(body: bytes) -> str:
    match = _METHOD.search(body, 0, _BEGINNING)
    return "" if match is None else match[1].decode("utf-8", "replace")
