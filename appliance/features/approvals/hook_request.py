"""The POST for a call that waits. No I/O.

1. The signature covers the time and the body, so a receiver can reject repetitions and changes.
2. Text of an agent is shown without control characters, and without the characters of HTML and of links in chats.
"""

import hashlib
import hmac
import html
import json

from appliance.audit.log.record_format import printable
from appliance.features.approvals.hook_link import CallWaits
from appliance.features.approvals.settings import ApprovalHook

LEAST_SECRET = 16
_LONGEST_TEXT = 200
_DOES = {"publish": "publish", "call": "call", "write": "write"}


def body_of(call: CallWaits, left: float, robot: str, console: str) -> bytes:
    """Return the JSON; `left` is the number of seconds until the call expires."""
    host, node, resource, type_ = map(_harmless, (call.host, call.caller_id, call.resource, call.type))
    does = _DOES.get(call.category, "use")
    where = f"{_harmless(robot)}: " if robot else ""
    link = f"{console}/console/robot" if console else ""
    fields = {
        "event": "approval wanted", "robot": _harmless(robot), "number": call.number, "host": host, "node": node,
        "category": call.category, "resource": resource, "type": type_, "expires_in_seconds": round(left, 1),
        "console": link,
        "text": f"{where}{host} wants to {does} {resource}: approval {call.number}, {left:.0f} s left. {link}".rstrip(),
    }  # fmt: skip
    return json.dumps(fields).encode()


def request_of(wanted: ApprovalHook, body: bytes, secret: bytes, seconds: int) -> bytes:
    """Return the whole request; `seconds` is the time of the signature, since the epoch."""
    signature = hmac.new(secret, f"{seconds}.".encode() + body, hashlib.sha256).hexdigest()
    head = (
        f"POST {wanted.target} HTTP/1.1",
        f"Host: {wanted.host[1]}",
        "Content-Type: application/json",
        f"Content-Length: {len(body)}",
        f"ROSRV-Signature: t={seconds},v1={signature}",
        "Connection: close",
    )
    return "\r\n".join((*head, "", "")).encode() + body


def _harmless(text: str) -> str:
    return html.escape(printable(text[:_LONGEST_TEXT]))
