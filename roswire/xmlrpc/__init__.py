"""XML-RPC as ROS 1 uses it, without I/O: parse requests and answers under limits, and build them.

Received bytes are never forwarded. They are parsed into values (`xmlrpc_reader`, or `common_documents` for simple
documents). After a decision, the values are encoded again (`xmlrpc_writer`).
"""

from dataclasses import dataclass

from roswire.errors import LimitExceededError, PeerError, ProtocolError
from roswire.xmlrpc.common_documents import read_common_answer, read_common_call
from roswire.xmlrpc.xmlrpc_reader import XmlRpcDocument
from roswire.xmlrpc.xmlrpc_values import DEFAULT_LIMITS, Value, XmlRpcLimits
from roswire.xmlrpc.xmlrpc_writer import build_call, build_fault, build_response

__all__ = [
    "DEFAULT_LIMITS",
    "FaultReceived",
    "MethodCall",
    "Value",
    "XmlRpcLimits",
    "build_call",
    "build_fault",
    "build_response",
    "parse_call",
    "parse_response",
]


@dataclass(frozen=True, slots=True)
class MethodCall:
    """`method` is as received."""

    method: str
    params: tuple[Value, ...]


class FaultReceived(PeerError):  # noqa: N818 - named as the event it is: the answer was a fault
    """The method failed."""

    def __init__(self, code: int, text: str) -> None:
        super().__init__(f"fault {code}: {text}")
        self.code = code
        self.text = text


def parse_call(body: bytes, limits: XmlRpcLimits = DEFAULT_LIMITS) -> MethodCall:
    """Raises `ProtocolError` or `LimitExceededError`."""
    parsed = read_common_call(body, limits)
    if parsed is None:
        document = XmlRpcDocument(body, limits, "methodCall")
        parsed = document.method, document.values
    method, params = parsed
    if method == "system.multicall" and params:
        parts = params[0]
        if isinstance(parts, list) and len(parts) > limits.parts:
            raise LimitExceededError(
                f"system.multicall of {len(parts)} calls; at most {limits.parts} are allowed"
            )
    return MethodCall(method, tuple(params))


def parse_response(body: bytes, limits: XmlRpcLimits = DEFAULT_LIMITS) -> Value:
    """Raises `FaultReceived` if the answer is a fault, `ProtocolError` or `LimitExceededError`."""
    parsed = read_common_answer(body, limits)
    if parsed is not None:
        return parsed
    document = XmlRpcDocument(body, limits, "methodResponse")
    if len(document.values) != 1:
        raise ProtocolError(f"answer with {len(document.values)} values; it has one")
    value = document.values[0]
    if not document.is_fault:
        return value
    if isinstance(value, dict):
        code, text = value.get("faultCode"), value.get("faultString")
        if type(code) is int and isinstance(text, str):
            raise FaultReceived(code, text)
    raise ProtocolError("fault without an integer faultCode and a string faultString")
