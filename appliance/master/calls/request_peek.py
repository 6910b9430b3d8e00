"""What a request asks for, by the beginning of its body: for the record of a refusal that reads no further. No I/O.

The beginning is a stranger's, and a few KiB. Where it is a whole call of a known table, the record has what a decision
of that call has: category and resource, the claimed name, the key or node. Else it has the method's name, if one is
there.
"""

from collections.abc import Mapping
from typing import Any, NamedTuple

from appliance.master.caller import Caller
from appliance.master.calls.call import Call, claimed_name
from appliance.master.calls.call_table import MASTER_CALLS
from appliance.master.calls.multicall import MULTICALL
from appliance.master.calls.node_calls import NODE_CALLS
from appliance.policy.model import Category
from appliance.rpc.method_name import method_named
from appliance.rpc.server import Peer
from roswire.errors import PeerError
from roswire.xmlrpc import Limits, Value, parse_call

_CALLS: Mapping[str, Call[Any]] = {**NODE_CALLS, **MASTER_CALLS}
_LIMITS = Limits(body=8192, elements=256, depth=16, string=4096, parts=64)
_UNKNOWN = "unknown"
_LONGEST = 200
_MOST_PARTS = 8


class Asked(NamedTuple):
    """What was asked for; `about` is detail as a decision's record has it."""

    category: Category
    resource: str
    caller_id: str | None
    about: dict[str, str]


def asked_for(peer: Peer, beginning: bytes) -> Asked:
    """What a peer's request with this beginning of a body asks for; an empty resource where nothing can be told."""
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
    return Asked(request.category, request.resource[:_LONGEST], request.caller_id, about)


def _only_named(method: str, caller_id: str | None, about: dict[str, str] | None = None) -> Asked:
    known = method if method in _CALLS or method == MULTICALL else _UNKNOWN
    return Asked(Category.COMMAND, method[:_LONGEST], caller_id, {"call": known, **(about or {})})


def _parts(params: tuple[Value, ...]) -> str:
    """The methods that a multicall asks for: the first of them."""
    parts = params[0] if params and isinstance(params[0], list) else []
    names = [str(part.get("methodName"))[:_LONGEST] for part in parts if isinstance(part, dict)]
    more = f" and {len(names) - _MOST_PARTS} more" if len(names) > _MOST_PARTS else ""
    return ", ".join(names[:_MOST_PARTS]) + more
